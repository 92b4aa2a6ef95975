"""Flights of real nodes from the command line: what they record, how they end, and who is named when a node fails."""

from __future__ import annotations

import signal
import socket
from pathlib import Path

import numpy as np
import pytest
from fly_helpers import fly, readable
from node_helpers import end_of, ros_graph

pytest.importorskip("dtsa_msgs.msg")

from dtsa_agent.core import SwarmConfig
from dtsa_agent.ros.common.node_process import RANGE
from dtsa_agent.stop import Stop
from dtsa_bench.commands.cli import main
from dtsa_bench.flights.children import Children
from dtsa_bench.flights.domain import clear_hindrances, ros_domain
from dtsa_bench.flights.flight import fly as fly_here
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.record import SLOT_RECORD
from dtsa_bench.runs.config import RunConfig
from dtsa_channel_sim import ChannelConfig, ClockConfig, make_clocks

pytestmark = pytest.mark.ros
LIVE = ("--mode", "realtime", "--policy")


def test_a_flight_leaves_a_bag_that_rosbags_reads_a_summary_and_a_picture(tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    out = tmp_path / "out"
    summary = fly(out, "--agents", "5", "--moving", "4", "--tail-s", "0.1")
    wanted = {"agents", "moving", "policy", "estimator", "avoider", "slot_ms", "loss", "seed", "slots", "collided",
              "min_distance_m", "efficiency_mean", "completion_time_s", "age_mean_slots", "age_max_slots",
              "estimate_error_mean_m", "wall_time_s", "realtime_factor"}  # fmt: skip
    assert wanted <= summary.keys()
    assert summary["end"] == "completed"
    total = summary["slots"]["total"]
    with AnyReader([out / "bag"]) as reader:
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        stamps = [time_ns for _, time_ns, _ in reader.messages()]
        records = [(data, c.msgtype) for c, _, data in reader.messages() if c.topic == SLOT_RECORD]
        last = reader.deserialize(*records[-1])
    assert counts == {
        SLOT_RECORD: total + 1,
        "/swarm/markers": -(-total // 5),
        "/swarm/configuration": 1,
        "/swarm/status": 2,  # it flies, it has ended
        **{f"/cf{k}/odom": -(-total // 5) for k in range(1, 6)},
    }
    assert stamps[0] == 1_000_000_000
    assert stamps[-1] == 1_000_000_000 + total * 10_000_000
    assert (last.agent.tolist(), len(last.chosen), last.slot) == ([1, 2, 3, 4, 5], 0, total)
    assert (out / "trajectories.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert (out / "trajectories.png").stat().st_size > 20_000


def test_slots_of_a_clock_start_when_that_clock_says_so() -> None:
    from drifting_clocks import to_channel

    from dtsa_agent.core.station import ClockMap

    config = ClockConfig(offset_ns=2_000_000, drift_ppm=50.0, seed=3)
    clocks = make_clocks(config, 6)
    maps = [ClockMap(clock.offset_ns, clock.drift_ppb) for clock in clocks]
    for slot in (0, 1, 777, 60_000):
        local = slot * 10_000_000
        expected = [to_channel(clock, local) - local for clock in clocks]
        assert [clock.monotonic_ns(local) - local for clock in maps] == expected


def test_the_channel_changes_in_flight_and_the_bag_still_verifies(tmp_path: Path) -> None:
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    out = tmp_path / "out"
    with ros_graph(tmp_path) as graph:
        parameters = ["agents:=4", "seed:=3", "tail_s:=3600.0", f"out:={out}"]
        channel = graph.start("dtsa_bench.flights.recorded_channel", *[w for p in parameters for w in ("-p", p)])
        host = graph.start("dtsa_agent.ros.swarm_host", "-p", "agents:=4", "-p", "seed:=3", "-p", "shared_table:=true")
        bag = out / "bag" / "bag_0.mcap"
        graph.until(lambda: bag.exists() and bag.stat().st_size > 20_000)
        change = graph.node.create_client(SetParameters, "/swarm/channel/set_parameters")
        graph.until(change.service_is_ready)
        for values, good in (({"loss": 0.5}, True), ({"loss": 1.5}, False), ({"partition": "[[1, 2], [3, 4]]"}, True)):
            request = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
            done = change.call_async(SetParameters.Request(parameters=request))
            graph.until(done.done)
            assert done.result().results[0].successful is good
            size = bag.stat().st_size
            graph.until(lambda size=size: bag.stat().st_size > size + 10_000)
        assert end_of(channel, signal.SIGINT)[0] == 0
        assert end_of(host) == (0, "")
    readable(out)
    with Bag(out / "bag") as recorded:
        events = [message for _, message in recorded.typed(["/parameter_events"])]
        records = [message for _, message in recorded.typed([SLOT_RECORD])][:-1]
        lost = [int(np.sum(message.lost)) for message in records]
        divided = [len(np.unique(message.digest)) for message in records]
    assert [event.changed_parameters[0].name for event in events] == ["loss", "partition"]
    assert lost[0] == 0
    assert max(lost) > 0
    assert divided[0] == 1
    assert max(divided) > 1  # what was one table for all became one an agent


@pytest.mark.parametrize(("words", "said"), [
    (["--agents", "4", "--moving", "6"], "moving: got 6; allowed: 0 to 4, the number of agents"),
    (["--axis-x-m", "64"], "extent_m: got 65.534; allowed: 66.1 m or more: starts and goals are up to 64.0"),
    (["--processes", "13"], "processes: got '13'; allowed: per-agent, or 1 to 12"),
    (["--domain", "233"], "domain: got '233'; allowed: a whole number, 0 to 232"),
    (["--mode", "turbo"], "mode: got 'turbo'; allowed: lockstep, realtime"),
    (["--estimator", "oracle"], "estimator: got 'oracle'; allowed: hold, linear or intent"),
    (["--respawn", "1"], "respawn: got 1.0; allowed: only with --mode realtime"),
    ([*LIVE, "tdma", "--respawn", "-1"], "respawn: got -1.0; allowed: 0 to 3600 s"),
    ([*LIVE, "dtsa", "--respawn", "1"], "policy: got 'dtsa'; allowed: tdma, aloha, lease"),
    (["--late", "cf2"], "late: got 'cf2'; allowed: cfK=S,..."),
    (["--late", "cf2=1"], "late: got {2: 1.0}; allowed: only with --mode realtime"),
    ([*LIVE, "tdma", "--late", "cf13=1"], "late: got {13: 1.0}; allowed: some, not all"),
    ([*LIVE, "lease", "--late", "cf2=1", "--processes", "2"], "late: got {2: 1.0}; allowed: only with --processes"),
])  # fmt: skip
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, capsys, words, said):
    assert main(["fly", "--out", str(tmp_path / "out"), *words]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"dtsa: error: {said}")
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_directory_or_a_domain_in_use_is_one_line_and_exit_code_2(tmp_path, capsys):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    assert main(["fly", "--out", str(tmp_path / "full")]) == 2
    assert capsys.readouterr().err.startswith("dtsa: error: out: got")
    with ros_domain() as taken:
        assert main(["fly", "--out", str(tmp_path / "out"), "--domain", str(taken)]) == 2
        assert "in use" in capsys.readouterr().err
        with ros_domain() as other:
            assert other != taken
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as somebody:
        somebody.bind(("", 7400 + 250 * taken + 10))
        assert main(["fly", "--out", str(tmp_path / "out"), "--domain", str(taken)]) == 2
        assert "in use" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_after_a_signal_no_process_is_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_LOG_DIR", "")  # put back afterwards
    swarm, stop = SwarmConfig(agents=4), Stop()
    stop.signal = signal.SIGINT
    run = RunConfig(swarm, ChannelConfig(agents=4, slot_ns=swarm.slot_ns))
    with pytest.raises(KeyboardInterrupt):
        fly_here(run, tmp_path / "out", stop=stop)
    assert list((tmp_path / "out" / "log").iterdir()) == []


def test_variables_of_a_shell_and_modules_in_its_folder_do_not_reach_agents(capsys, tmp_path, monkeypatch):
    shell = {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp", "ROS_DISCOVERY_SERVER": "a:1", RANGE: "OFF", "HOME": "/"}
    clear_hindrances(shell)
    assert shell == {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", RANGE: "LOCALHOST", "HOME": "/"}
    said = [line.split("=")[0] for line in capsys.readouterr().err.splitlines()]
    assert said == ["dtsa: RMW_IMPLEMENTATION", "dtsa: ROS_DISCOVERY_SERVER", f"dtsa: {RANGE}"]
    clear_hindrances(shell)
    assert not capsys.readouterr().err
    (tmp_path / "numpy.py").write_text("raise RuntimeError('not NumPy')")
    monkeypatch.chdir(tmp_path)
    children = Children(tmp_path, {})
    children.start("one", [1], "dtsa_channel_sim.model.channel", ["word"])
    assert children.all[0].process.wait(60) == 0, children.all[0].log.read_text()
