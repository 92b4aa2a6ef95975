"""The ROS form on several hosts: one DDS domain, the channel on one of them, agents on the others, in lockstep."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dtsa_agent.core import SwarmConfig
from dtsa_agent.ros.common.workarounds.dds import PEERS, PROFILES, RANGE
from dtsa_bench.recordings.verify import verify_bag
from dtsa_bench.runs.config import RunConfig, RunLimits, from_swarm
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim import ChannelConfig
from dtsa_dev.network.hosts import Host, Unavailable, hosts
from dtsa_dev.network.lan import Lan
from dtsa_dev.soak.checks import met
from dtsa_dev.soak.item import Item, NotMet
from dtsa_dev.soak.nodes import node_command

HOSTS, A_HOST = 3, 4  # with agents, beside the channel's; agents on each
_GROUP = "127.0.1"  # end of 239.255.0.1, where DDS looks for others
_LOSS = 0.05
_FLIGHT_S = 3.0
_PATIENCE_S = 240.0  # for the whole flight, on a machine that is busy
MULTICAST, STATIC_PEERS = "multicast", "static peers"
#: What of the summary is the simulator's to the digit.
SAME = ("slots", "age_mean_slots", "estimate_error_mean_m", "min_distance_m", "collided", "completed")


def items() -> Iterator[Item]:
    """Both ways of discovery."""
    for discovery in (MULTICAST, STATIC_PEERS):
        settings = {"ros": True, "discovery": discovery, "hosts": HOSTS, "agents": HOSTS * A_HOST}
        yield Item(f"ROS form on {HOSTS + 1} hosts, {discovery}", settings, 31, 30.0, sample=discovery == MULTICAST)


def run(item: Item, directory: Path) -> dict[str, Any]:
    """Flies one item.

    :param item: one of this module's.
    :param directory: an empty one.
    :raises NotMet: if the flight does not end in order, or is another one than the simulator's.
    """
    swarm = SwarmConfig(agents=item.settings["agents"], policy="lease", seed=item.seed)
    discovery = item.settings["discovery"]
    try:
        with hosts(item.settings["hosts"] + 1) as joined:
            lan = Lan(joined)
            _fly(swarm, joined, lan, discovery, directory)
    except Unavailable as error:
        raise NotMet(str(error)) from error
    searched = lan.to_groups[_GROUP]
    met((searched > 0) == (discovery == MULTICAST), f"{searched} frames of discovery to all, by {discovery}")
    carried = {"frames": lan.carried, "discovery_to_all": searched, "undelivered": lan.undelivered}
    return {"discovery": discovery, "carried": carried, **_judged(swarm, directory)}


def environment(discovery: str, joined: Sequence[Host]) -> dict[str, str]:
    """Variables of the nodes on all hosts.

    :param discovery: :data:`MULTICAST` or :data:`STATIC_PEERS`.
    :param joined: the hosts.
    """
    plain = {name: value for name, value in os.environ.items() if name not in (*PROFILES, RANGE, PEERS)}
    plain["ROS_DOMAIN_ID"] = "0"
    if discovery == MULTICAST:
        return {**plain, RANGE: "SUBNET"}
    return {**plain, RANGE: "LOCALHOST", PEERS: ";".join(host.address for host in joined)}


def _fly(swarm: SwarmConfig, joined: Sequence[Host], lan: Lan, discovery: str, directory: Path) -> None:
    """The channel on the first host, agents on the others; none is left afterwards."""
    shared = {"agents": swarm.agents, "policy": swarm.policy, "seed": swarm.seed}
    channel = {**shared, "loss": _LOSS, "timeout_s": _FLIGHT_S, "out": directory / "flight"}
    channel |= {"stop_on_crash": "false", "startup_s": _PATIENCE_S / 2, "answer_s": _PATIENCE_S / 2}
    commands = [_command("dtsa_bench.flights.recorded_channel", channel)]
    each = swarm.agents // (len(joined) - 1)
    for number in range(len(joined) - 1):
        ids = list(range(number * each + 1, (number + 1) * each + 1))
        commands.append(_command("dtsa_agent.ros.swarm_host", {**shared, "ids": str(ids).replace(" ", "")}))
    known = {**environment(discovery, joined), "ROS_LOG_DIR": str(directory)}
    found: list[subprocess.Popen[str]] = []
    with (directory / "said.txt").open("w") as said:
        try:
            for host, command in zip(joined, commands, strict=True):
                found.append(
                    host.start(command, own_memory=True, env=known, stdout=subprocess.DEVNULL, stderr=said)
                )  # fmt: skip
            lan.run(lambda: all(process.poll() is not None for process in found), _PATIENCE_S)
            codes = [process.poll() for process in found]
        finally:
            for process in found:
                process.kill()
                process.wait()
    text = " ".join((directory / "said.txt").read_text(encoding="utf-8").split())[-400:]
    met(not any(codes) and None not in codes, f"nodes ended with {codes}: {text}")


def _command(module: str, values: dict[str, Any]) -> list[str]:
    return node_command(module, *(word for name, value in values.items() for word in ("-p", f"{name}:={value}")))


def _judged(swarm: SwarmConfig, directory: Path) -> dict[str, Any]:
    """The bag is what the protocol gives, and the flight the simulator's."""
    summary = json.loads((directory / "flight" / "summary.json").read_text(encoding="utf-8"))
    verified = verify_bag(directory / "flight" / "bag")
    met(verified.ok, f"the bag does not verify: {verified}")
    limits = RunLimits(timeout_s=_FLIGHT_S, stop_on_crash=False)
    again = simulate(RunConfig(swarm, ChannelConfig(loss=_LOSS, **from_swarm(swarm)), limits)).summary()
    other = {name: [summary.get(name), again[name]] for name in SAME if summary.get(name) != again[name]}
    met(not other, f"not the simulator's flight: {other}")
    return {"slots": summary["slots"], "age_mean_slots": summary["age_mean_slots"], "as_simulated": True,
            "wall_time_s": summary["wall_time_s"]}  # fmt: skip
