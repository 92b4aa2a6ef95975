"""The switch of trials: the channel model's medium between cables; and agents on hosts of their own, joined by it."""

from __future__ import annotations

import dataclasses
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from dtsa_dev.network.hosts import EmulatedHost, hosts, why_not
from dtsa_dev.network.switch import Intruder, Links, Switch
from trials import Trial, TrialError, flight_time, under_way

import dtsa
from dtsa_agent.air.port import link_of
from dtsa_agent.core import Frame, SwarmConfig, encode_frame
from dtsa_agent.core.station import StationSettings
from dtsa_bench.log.merge.merge import Merge, is_verified
from dtsa_bench.log.merged_bag import write_merged
from dtsa_bench.log.verify.check import verify_bag
from dtsa_channel_sim import ChannelConfig

GROUP = ("239.1.2.3", 4567)
CONFIG = SwarmConfig(agents=3, policy="tdma")


def ethernet(payload: bytes, group: tuple[str, int] = GROUP, protocol: int = 17) -> bytes:
    udp = struct.pack("!HHHH", 5000, group[1], 8 + len(payload), 0) + payload
    head = struct.pack("!BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 1, protocol, 0, b"\x0a\0\0\1",
                       socket.inet_aton(group[0]))  # fmt: skip
    return bytes(12) + b"\x08\x00" + head + udp


def frame(sender: int, slot: int) -> bytes:
    state = ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
    return ethernet(StationSettings(CONFIG, link_of(CONFIG)).write(encode_frame(Frame(sender, slot, 1, *state)), slot))


class Cables:
    """Three cables, and a switch between them that needs no hosts."""

    def __init__(self, links: Links | None = None, **channel: Any) -> None:
        self.pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM) for _ in range(3)]
        for end in (end for pair in self.pairs for end in pair):
            end.setblocking(False)
        joined = [EmulatedHost(k + 1, "", pair[0].fileno(), -1) for k, pair in enumerate(self.pairs)]
        self.switch = Switch(joined, GROUP, ChannelConfig(agents=3, link_delay_ns=0, **channel), links)

    def send(self, host: int, data: bytes) -> None:
        self.pairs[host - 1][1].send(data)

    def carry(self, frames: int, longer_s: float = 0.02) -> None:
        """Carry until so many frames have left the air, and a little longer."""
        assert self.switch.run(lambda: len(self.switch.log) >= frames, 30.0)
        self.switch.run(lambda: False, longer_s)

    def heard(self, host: int) -> list[bytes]:
        found: list[bytes] = []
        with suppress(BlockingIOError):
            while True:
                found.append(self.pairs[host - 1][1].recv(4096))
        return found


@pytest.fixture
def cables(request: pytest.FixtureRequest) -> Iterator[Cables]:
    joined = Cables(**getattr(request, "param", {}))
    yield joined
    for end in (end for pair in joined.pairs for end in pair):
        end.close()


def test_a_frame_reaches_all_others_as_it_was_sent(cables: Cables) -> None:
    cables.send(2, frame(2, 7))
    cables.carry(1)
    assert [cables.heard(host) for host in (1, 2, 3)] == [[frame(2, 7)], [], [frame(2, 7)]]
    (seen,) = cables.switch.log
    assert (seen.sender, seen.agent, seen.slot, seen.received, seen.lost, seen.collided) == (2, 2, 7, 2, 0, 0)
    # 45 bytes at 2 Mbit/s and the radio's way to sending
    assert seen.end_ns - seen.start_ns == 130_000 + (73 + 8 * 47) * 500


@pytest.mark.parametrize("cables", [{"bitrate": 2000}], indirect=True)  # 0.2 s on the air
def test_frames_that_overlap_destroy_each_other(cables: Cables) -> None:
    cables.send(1, frame(1, 3))
    cables.send(2, frame(2, 3))
    cables.carry(2)
    assert [cables.heard(host) for host in (1, 2, 3)] == [[], [], []]
    assert [seen.collided > 0 for seen in cables.switch.log] == [True, True]


def test_what_is_no_frame_is_not_on_the_air_and_frames_take_as_long_as_agents_are_told(cables: Cables) -> None:
    good = frame(1, 1)
    strange = (b"", bytes(60), good[:30], good[:50], ethernet(b"x" * 40), frame(1, 1)[:12] + b"\x86\xdd" + good[14:])
    for data in strange:
        cables.send(1, data)
    for other in (ethernet(good[42:], ("239.1.2.4", 4567)), ethernet(good[42:], ("239.1.2.3", 1))):
        cables.send(1, other)
    cables.send(1, ethernet(good[42:], protocol=6))
    cables.send(3, good)
    cables.carry(1)
    assert [len(cables.heard(host)) for host in (1, 2, 3)] == [1, 1, 0]
    assert cables.switch.left_out >= len(strange) + 2
    config = ChannelConfig(agents=3)
    fixed, byte = flight_time(config.airtime)
    assert fixed + byte * 68 == config.airtime.total_ns(68)


SWARM = SwarmConfig(
    agents=4, policy="lease", slot_ms=20.0, open_every=0, adoption=False, auth=True, auth_session=5,
    scenario="waypoints",
)  # fmt: skip


@pytest.mark.skipif(bool(why_not()), reason=why_not() or "hosts can be made")
@pytest.mark.realtime
def test_agents_on_hosts_of_their_own_live_through_a_death_and_a_partition(tmp_path: Path) -> None:
    """Cold start in random order, drifts, losses; one is killed and comes back; the air is cut in two for a while."""
    trial = Trial(SWARM, {"loss": 0.1}, seconds=2.0, spread_s=0.3, drift_ppm=50.0)
    home = os.readlink("/proc/self/ns/net")
    with under_way(trial, tmp_path) as flight:
        assert os.readlink("/proc/self/ns/net") == home
        flight.carry(1.0)
        flight.signal(2, signal.SIGKILL)
        flight.switch.set(partition=[[1, 2], [3, 4]])
        flight.start(2)
        flight.carry(1.0)
        flight.switch.set(partition="")
        frames = len([seen for seen in flight.switch.log if seen.sender == 2])

        def back() -> bool:
            return len([seen for seen in flight.switch.log if seen.sender == 2]) > frames + 3

        assert flight.switch.run(back, 60.0)
        stranger = Intruder(flight.switch, 1)
        flight.carry(0.5)
        flight.end()
        merged = Merge(flight.bags())
        found = merged.summary()
    assert os.readlink("/proc/self/ns/net") == home
    assert found["broken_off"] == ["cf2"]
    assert (found["bags"], found["missing"], found["not_on_the_time_line"]) == (5, [], [])
    assert is_verified(found), found["decisions_again"]
    assert found["slots_with_two_senders"] == 0
    assert found["flight"] is not None
    assert stranger.sent_count > 10
    refused = {reason for counts in found["not_taken_in"].values() for reason in counts}
    assert {"other time", "repeated", "rejected"} <= refused
    whole = tmp_path / "whole"
    write_merged(whole, merged.log, found)
    assert verify_bag(whole).to_dict()["difference"] is None
    run = dtsa.open(whole)
    assert run.summary == found["flight"]
    assert run.frames.lost.sum() > 0


@pytest.mark.skipif(bool(why_not()), reason=why_not() or "hosts can be made")
def test_hosts_have_clocks_of_their_own() -> None:
    with hosts(1) as joined:
        says = [sys.executable, "-c", "import time; print(time.monotonic(), time.time())"]
        process = joined[0].start(says, 1_000_000, stdout=subprocess.PIPE)
        monotonic, real = map(float, process.communicate(timeout=60.0)[0].split())
    if monotonic < time.monotonic() + 900_000:
        pytest.skip("no time namespaces here")
    assert abs(monotonic - time.monotonic() - 1_000_000) < 60.0
    assert abs(real - time.time()) < 60.0


@pytest.mark.skipif(bool(why_not()), reason=why_not() or "hosts can be made")
def test_agents_say_in_flight_that_slots_are_too_short_for_a_network(tmp_path: Path) -> None:
    swarm = SwarmConfig(agents=3, policy="tdma", slot_ms=20.0)
    with under_way(Trial(swarm, links=Links(jitter_ns=40_000_000), spread_s=0.0), tmp_path) as flight:

        def said() -> bool:
            return all("ms are too short for this network" in path.read_text() for path in tmp_path.glob("*.err"))

        assert flight.switch.run(said, 60.0)
        flight.end()
    assert all(bag.summary["slots_too_short"] for bag in flight.bags())


@pytest.mark.skipif(bool(why_not()), reason=why_not() or "hosts can be made")
def test_an_agent_that_does_not_begin_says_why(tmp_path: Path) -> None:
    wrong = dataclasses.replace(SWARM, agents=1, policy="dtsa", moving=None)
    with pytest.raises(TrialError, match="policy: got 'dtsa'"), under_way(Trial(wrong, spread_s=0.0), tmp_path):
        pass
