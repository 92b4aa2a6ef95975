"""Fast DDS on one machine: sockets on loopback alone, and nothing in shared memory."""

from __future__ import annotations

from pathlib import Path

import pytest
from node_helpers import ros_graph
from process_helpers import addresses, segments_of
from rclpy.node import Node

from dtsa_agent.core.errors import DtsaError, LocalProtocolError
from dtsa_agent.ros.common.node_process import PEERS, PROFILE, PROFILES, RANGE, TRANSPORTS, ending, limit_to_machine


def test_localhost_becomes_our_profile_and_other_wishes_stay() -> None:
    plain = {RANGE: "LOCALHOST"}
    for said in ("LOCALHOST", "SYSTEM_DEFAULT", "LOCALHOST"):  # a supervisor's, and those of its nodes
        plain[RANGE] = said
        limit_to_machine(plain)
        assert plain == {RANGE: "SYSTEM_DEFAULT", PROFILES[0]: str(PROFILE), PROFILES[1]: str(PROFILE)}
    for other in (
        {RANGE: "LOCALHOST", "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"},
        {RANGE: "LOCALHOST", PROFILES[0]: "/mine.xml"},
        {TRANSPORTS: "LARGE_DATA"},
    ):
        before = dict(other)
        limit_to_machine(other)
        assert other == before
    for wider in ({}, {RANGE: "SUBNET"}, {RANGE: "LOCALHOST", PEERS: "10.0.0.2;10.0.0.3"}):
        before = dict(wider)
        limit_to_machine(wider)
        assert wider == {**before, TRANSPORTS: "UDPv4"}


def test_a_node_ends_with_its_context_whatever_happens(tmp_path: Path) -> None:
    with ros_graph(tmp_path) as graph:
        node = Node("ending", context=graph.node.context)
        names = graph.node.get_node_names
        graph.until(lambda: "ending" in names())
        with pytest.raises(DtsaError), ending(node):
            raise LocalProtocolError("cf1 is dead")
        graph.until(lambda: "ending" not in names())


@pytest.mark.ros
def test_nodes_listen_on_loopback_only_and_share_no_memory(tmp_path: Path) -> None:
    with ros_graph(tmp_path) as graph:
        node = graph.start("dtsa_channel_sim.ros.channel_node", "-p", "agents:=2")
        graph.until(lambda: ("channel", "/swarm") in graph.node.get_node_names_and_namespaces())
        assert addresses(node.pid) == {"127.0.0.1"}
        assert segments_of(node.pid) == set()
