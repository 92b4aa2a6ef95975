"""Integration: ROS nodes on hosts of their own, in one DDS domain; more hosts and multicast: `tools/dtsa soak air`."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("dtsa_msgs.msg")

from dtsa_dev.network.hosts import why_not
from dtsa_dev.soak.air import ros_hosts
from dtsa_dev.soak.item import Item


@pytest.mark.ros
def test_nodes_on_two_hosts_that_know_each_others_addresses_fly_the_simulators_flight(tmp_path: Path) -> None:
    if reason := why_not():
        pytest.skip(reason)
    settings = {"discovery": ros_hosts.STATIC_PEERS, "hosts": 1, "agents": 2}
    found = ros_hosts.run(Item("two hosts", settings, seed=5), tmp_path)
    assert found["as_simulated"]
    assert found["slots"]["total"] > 0
    assert found["carried"]["frames"] > 2 * found["slots"]["total"]  # a slot, and its answers
