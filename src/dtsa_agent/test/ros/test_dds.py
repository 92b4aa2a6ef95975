"""Fast DDS on one machine: sockets on loopback alone, shared memory of the dead removed and of the living kept."""

from __future__ import annotations

import fcntl
import os
import signal
import time
from pathlib import Path

import pytest
from node_helpers import ros_graph
from process_helpers import addresses, segments_of
from rclpy.node import Node

from dtsa_agent.core.errors import DtsaError, LocalProtocolError, RemoteProtocolError
from dtsa_agent.ros.common.process.node_process import SUPERVISOR, in_real_time
from dtsa_agent.ros.common.workarounds import dds
from dtsa_agent.ros.common.workarounds.dds import PROFILE, PROFILES, RANGE, clean_shared_memory, limit_to_machine
from dtsa_agent.ros.common.workarounds.kept_nodes import ending

SHARED_MEMORY = Path("/dev/shm")


def test_localhost_becomes_our_profile_and_other_wishes_stay() -> None:
    plain = {RANGE: "LOCALHOST"}
    limit_to_machine(plain)
    assert plain == {RANGE: "SYSTEM_DEFAULT", PROFILES[0]: str(PROFILE), PROFILES[1]: str(PROFILE)}
    for other in (
        {},
        {RANGE: "SUBNET"},
        {RANGE: "LOCALHOST", "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"},
        {RANGE: "LOCALHOST", PROFILES[0]: "/mine.xml"},
        {RANGE: "LOCALHOST", dds.PEERS: "10.0.0.2;10.0.0.3"},
    ):
        before = dict(other)
        limit_to_machine(other)
        assert other == before
    # Supervisor and node may have it otherwise.
    limit_to_machine(plain, shared_memory=False)
    assert plain == {RANGE: "SYSTEM_DEFAULT", PROFILES[0]: str(dds.PUNCTUAL), PROFILES[1]: str(dds.PUNCTUAL)}
    limit_to_machine(plain)
    assert plain[PROFILES[0]] == str(PROFILE)


@pytest.mark.parametrize(("error", "lasts"), [(LocalProtocolError, True), (RemoteProtocolError, False)])
def test_a_node_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[DtsaError], lasts: bool) -> None:
    kept: list[Node] = []
    monkeypatch.setattr("dtsa_agent.ros.common.workarounds.kept_nodes._KEPT", kept)
    with ros_graph(tmp_path) as graph:
        node = Node("ending", context=graph.node.context)
        with pytest.raises(error), ending(node):
            raise error("cf1 is dead")
        assert kept == ([node] if lasts else [])
        names = graph.node.get_node_names
        graph.until(lambda: ("ending" in names()) == lasts)
        node.destroy_node()


def test_real_time_is_seen_in_the_command_line(tmp_path: Path) -> None:
    live, lockstep = tmp_path / "live.yaml", tmp_path / "lockstep.yaml"
    live.write_text("/**:\n  ros__parameters:\n    agents: 12\n    mode: realtime\n")
    lockstep.write_text("/**:\n  ros__parameters:\n    mode: lockstep  # not realtime\n    recording_mode: realtime\n")
    ros = ["agent", "--ros-args"]
    assert in_real_time([*ros, "-p", "id:=1", "-p", "mode:=realtime"])
    assert in_real_time([*ros, "--params-file", str(lockstep), "--params-file", str(live)])
    for words in ([], ["-p"], ["-p", "mode:=lockstep"], ["--params-file", str(lockstep)], ["--params-file", "none"]):
        assert not in_real_time([*ros, *words])


@pytest.mark.ros
def test_nodes_listen_on_loopback_only_and_leave_nothing_after_kill_9(tmp_path: Path) -> None:
    with ros_graph(tmp_path) as graph:
        node = graph.start("dtsa_channel_sim.ros.channel_node", "-p", "agents:=2")
        names = graph.node.get_node_names_and_namespaces
        # Found by a node that knows nothing of our profile: what the `ros2` command would see.
        graph.until(lambda: ("channel", "/swarm") in names())
        assert addresses(node.pid) == {"127.0.0.1"}
        segments = segments_of(node.pid)
        assert segments
        clean_shared_memory()
        assert all((SHARED_MEMORY / name).exists() for name in segments), "removed what is in use"
        live = ("-r", "__ns:=/north", "-p", "agents:=2", "-p", "mode:=realtime")
        punctual = graph.start("dtsa_channel_sim.ros.channel_node", *live)
        graph.until(lambda: ("channel", "/north") in names())
        assert addresses(punctual.pid) == {"127.0.0.1"}
        assert segments_of(punctual.pid) == set()
        time.sleep(1.1)  # the age below which nothing is touched
        node.send_signal(signal.SIGKILL)
        node.wait()
        clean_shared_memory()
        assert not [name for name in segments if (SHARED_MEMORY / name).exists()]


def test_a_node_shares_memory_only_if_its_supervisor_does(tmp_path: Path) -> None:
    """Where many processes do, they wait for each other's ports for minutes."""
    with ros_graph(tmp_path) as graph:
        graph.environment |= {SUPERVISOR: str(os.getpid()), RANGE: "SYSTEM_DEFAULT"}
        for profile in (PROFILE, dds.PUNCTUAL):
            graph.environment |= dict.fromkeys(PROFILES, str(profile))
            node = graph.start("dtsa_agent.ros.swarm_host", "-r", f"__node:={profile.stem}", "-p", "agents:=2")
            graph.until(lambda profile=profile: profile.stem in graph.node.get_node_names())
            assert bool(segments_of(node.pid)) == (profile == PROFILE)


def test_only_what_nobody_has_locked_and_is_not_young_is_removed(tmp_path: Path) -> None:
    def make(name: str, age_s: float = 100.0, locks: tuple[str, ...] = ("_el",)) -> Path:
        for suffix in ("", *locks):
            file = tmp_path / f"{name}{suffix}"
            file.write_bytes(b"")
            os.utime(file, (time.time() - age_s,) * 2)
        return tmp_path / name

    dead, held, port = make(f"fastrtps_{1:016x}"), make(f"fastrtps_{3:016x}"), make("fastrtps_port7000", locks=())
    other = make("something_else")
    mutex = tmp_path / f"sem.{port.name}_mutex"
    mutex.write_bytes(b"")
    with Path(f"{held}_el").open() as holder:
        fcntl.flock(holder, fcntl.LOCK_EX)  # belongs to this open file: for any other it is as another process's
        young, fresh_port = make(f"fastrtps_{2:016x}", 0.0), make("fastrtps_port7001", 1.0, ())
        assert sorted(clean_shared_memory(tmp_path)) == [dead.name, port.name]
    assert not dead.exists()
    assert not Path(f"{dead}_el").exists()
    assert not port.exists()
    assert not mutex.exists()
    assert all(file.exists() for file in (young, held, fresh_port, other))


def test_what_a_living_process_has_made_anew_meanwhile_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two clean up at once: one has removed the dead one's port, and a new process has made its own of that name."""
    port, lock = tmp_path / "fastrtps_port7411", tmp_path / "fastrtps_port7411_sl"
    for file in (port, lock):
        file.write_bytes(b"dead")
        os.utime(file, (1.0, 1.0))
    flock = fcntl.flock

    def late(descriptor: int, how: int) -> None:
        for file in (port, lock):
            file.unlink()
            file.write_bytes(b"living")
        flock(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", late)
    assert clean_shared_memory(tmp_path) == []
    assert port.read_bytes() == lock.read_bytes() == b"living"


def test_what_is_young_is_not_even_locked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its owner is about to lock it, and does not wait."""
    for name in ("fastrtps_port7411", "fastrtps_port7411_sl"):
        (tmp_path / name).write_bytes(b"")
    locked: list[int] = []
    monkeypatch.setattr(fcntl, "flock", lambda descriptor, how: locked.append(descriptor))
    assert clean_shared_memory(tmp_path) == []
    assert not locked
