"""Integration: interfaces that get another address, go, and are made anew, on hosts of their own, in flight."""

from __future__ import annotations

import json
import select
import time
from pathlib import Path

import pytest
from dtsa_dev.network.hosts import CABLE, Host, hosts, inside, why_not
from trials import Trial, under_way

from dtsa_agent.air.udp import MulticastSocket, UdpPort, UdpSettings
from dtsa_agent.core import SwarmConfig
from dtsa_bench.recordings.merge.merge import Merge, verified

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not() or "hosts can be made")
_LONG_S = 30.0


def change_address(host: Host) -> None:
    """Its interface gets another address."""
    host.readdress("10.68.9.9")


def make_anew(host: Host) -> None:
    """Its interface goes; another one of its name and address is made."""
    host.unplug()
    host.plug(host.address)


def heard(end: MulticastSocket, data: bytes) -> list[bool]:
    """Whether what arrives is an own datagram, of each that arrives with this content; waits for the first."""
    found: list[bool] = []
    until = time.monotonic() + _LONG_S
    while not found and time.monotonic() < until:
        select.select([end], [], [], 0.05)
        found = [one.own for one in end.receive(64) if one.data == data]
    return found


@pytest.mark.parametrize("change", [change_address, make_anew])
def test_a_socket_comes_back_to_an_interface_that_has_changed(change: object) -> None:
    assert callable(change)
    said: list[str] = []
    with hosts(1) as (host,), inside(host):
        settings = UdpSettings(interface=CABLE)
        with UdpPort(settings) as port, MulticastSocket(settings) as listener:
            port.say = said.append
            assert port.send(b"before") == ""
            assert (heard(port, b"before"), heard(listener, b"before")) == ([True], [False])
            change(host)
            assert port.send(b"after") == ""
            assert heard(port, b"after") == [True]
            again = b""
            until = time.monotonic() + _LONG_S
            while not listener.interface_changes and time.monotonic() < until:
                listener.receive(64)
                time.sleep(0.05)
            again = b"again"
            assert port.send(again) == ""
            assert (heard(listener, again), heard(port, again)) == ([False], [True])
            assert (port.counts()["interface_changes"], listener.interface_changes) == (1, 1)
    assert len(said) == 1
    assert said[0].startswith(f"interface {CABLE} is another one now")


SWARM = SwarmConfig(agents=4, policy="lease", slot_ms=20.0, auth=True, auth_session=5, scenario="waypoints")


@pytest.mark.realtime
def test_agents_fly_on_when_their_interfaces_change(tmp_path: Path) -> None:
    """cf2 gets another address, cf3 has no interface for a while, that of cf4 is off for a while."""
    with under_way(Trial(SWARM, seconds=4.0, spread_s=0.2), tmp_path) as flight:
        flight.carry(1.0)
        joined = flight.hosts
        change_address(joined[2])
        joined[3].unplug()
        joined[4].switch(up=False)
        flight.carry(2.0)
        joined[3].plug(joined[3].address)
        joined[4].switch(up=True)
        flight.wait_for_frames((2, 3, 4))
        flight.carry(1.0)
        flight.end()
        found = Merge(flight.bags()).judge()
    assert verified(found), found["decisions_again"]
    summaries = [json.loads((tmp_path / f"cf{agent}-1" / "summary.json").read_text()) for agent in (1, 2, 3, 4)]
    assert [one["interface_changes"] for one in summaries] == [0, 1, 1, 0]
    assert summaries[3]["unsent_because"]["Network is unreachable"] > 0
    errors = {agent: (tmp_path / f"cf{agent}-1.err").read_text() for agent in (1, 2, 3, 4)}
    assert "is another one now" in errors[2]
    assert errors[3].count("has gone") == 1
    assert "frames leave again" in errors[3]
    assert "frames leave again" in errors[4]
