"""The simulated channel beside ns-3's: the same loads, and who hears what."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.registry import POLICIES
from dtsa_bench.experiments.batch.task import Row
from dtsa_channel_sim import ChannelConfig
from dtsa_dev.soak.item import Item, NotMet, Soak

from .carry import traffic
from .compare import carried, contended, non_persistent_csma, pure_aloha, slotted_aloha
from .contend import BACKOFF_NS, CsmaCa, contend, waits_ns
from .other_python import ask, check

AGENTS = 20
#: Frames of the same instants on both channels, by the loads.
CARRIED = {
    "pure ALOHA": (0.1, 0.2, 0.5, 1.0, 2.0),
    "pure ALOHA, hidden senders": (0.2, 0.5, 1.0),
    "slotted ALOHA": (0.1, 0.2, 0.5, 1.0, 2.0),
    "slotted ALOHA, built in": (1.0,),
    "TDMA": (1.0,),
    "CSMA": (0.2, 0.5, 1.0),
    "CSMA, hidden senders": (0.5,),
}
#: Each side contends for itself, by the loads that senders would make that never wait.
CONTENDED = {"CSMA/CA": (0.1, 0.25, 0.5, 1.0, 2.0), "CSMA beside CSMA/CA": (0.1, 0.25, 0.5, 1.0)}
_SEEDS = (1, 2, 3)
_FRAMES = {"carried": 20_000, "contended": 40_000}  # of a run, about
_HIDDEN_M = 3.0  # range within which about a quarter of the swarm hears a sender
#: 802.15.4 at 250 kbit/s: a frame of 133 bytes with its preamble, 116 of them for the user, and the turn to sending.
_ON_AIR_NS, _TURN_NS, _PAYLOAD = 4_256_000, 192_000, 116
_FRAME = SwarmConfig(agents=2, frame="extended").frame_length
_BITRATE = round((ChannelConfig(agents=2).airtime.overhead_bits + 8 * _FRAME) * 1e9 / _ON_AIR_NS)
#: In ns-3 a frame is this many times as strong as noise: 0.05 % are lost alone, 99.8 % under another one of its length.
_SIGNAL = 1.6
_MIN_BE, _MAX_BE, _BACKOFFS = 3, 5, 4  # the standard's
_FIXED_BE, _MOST_BACKOFFS = 5, 5  # for a window that does not grow; ns-3 allows no more
_SAME_THROUGHPUT, _SAME_WAIT = 0.02, 0.04  # of CSMA/CA, relative


def _items() -> tuple[Item, ...]:
    carry = [
        Item(f"{scheme}, {load:g}", {"scheme": scheme, "load": load}, 1, 15.0, sample=load == 0.5)
        for scheme, loads in CARRIED.items()
        for load in loads
    ]
    own = [
        Item(
            f"{scheme}, {load:g}, {seed}", {"scheme": scheme, "load": load}, seed, 15.0, sample=(load, seed) == (0.5, 1)
        )
        for scheme, loads in CONTENDED.items()
        for load in loads
        for seed in _SEEDS
    ]
    return (*carry, *own)


def _run(item: Item, directory: Path) -> dict[str, Any]:
    scheme, load = str(item.settings["scheme"]), float(item.settings["load"])
    if scheme in CARRIED:
        return _carry(scheme, load, item.seed)
    return _contend(scheme, load, item.seed)


def load_of(scheme: str, load: float, seed: int) -> tuple[SwarmConfig, ChannelConfig, int]:
    """The swarm, the channel and the number of slots of a load whose frames ns-3 carries as well.

    :param scheme: one of CARRIED.
    :param load: frames begun in the time of one, or in a slot.
    :param seed: of the swarm.
    """
    frame_ns = ChannelConfig(agents=AGENTS).airtime.on_air_ns(_FRAME)
    policy, options = {
        "pure ALOHA": ("pure-aloha", {"pure-aloha.load": load}),
        # Whatever its age, an agent sends with probability load / N.
        "slotted ALOHA": ("threshold-aloha", {"threshold-aloha.threshold": 0.0, "threshold-aloha.rate": load}),
        "slotted ALOHA, built in": ("aloha", {}),
        "TDMA": ("tdma", {}),
        "CSMA": ("csma", {"csma.period_ms": AGENTS * frame_ns / load / 1e6}),
    }[scheme.removesuffix(", hidden senders")]
    swarm = SwarmConfig(agents=AGENTS, policy=policy, frame="extended", seed=seed, options=options)
    channel = ChannelConfig(
        agents=AGENTS,
        slot_ns=swarm.slot_ns,
        # A sender of ns-3 hears until its first bit. So does one of ours, but where CSMA needs the time in between.
        ramp_up_ns=ChannelConfig(agents=AGENTS).ramp_up_ns if policy == "csma" else 0,
        range_m=_HIDDEN_M if "hidden" in scheme else 0.0,
    )
    unit_ns = frame_ns if swarm.policy_row.unslotted else swarm.slot_ns
    return swarm, channel, max(1, round(_FRAMES["carried"] * unit_ns / load / swarm.slot_ns))


def _carry(scheme: str, load: float, seed: int) -> dict[str, Any]:
    swarm, channel, slots = load_of(scheme, load, seed)
    ours = traffic(swarm, channel, slots)
    theirs = ask(
        {
            "kind": "carry",
            "positions": ours.positions,
            "range_m": channel.range_m,
            "on_air_ns": ours.on_air_ns,
            "frames": ours.frames,
        }
    )
    found = {"scheme": scheme, "load": load, "ns3": theirs["version"], **carried(ours, theirs["heard"])}
    if found["differ"] or found["arrivals_apart_ns"]:
        raise NotMet(f"{found['differ']} of {found['pairs']} differ, arrivals by {found['arrivals_apart_ns']} ns")
    if scheme == "pure ALOHA":
        found["formula"] = pure_aloha(load, AGENTS)
    elif scheme.startswith("slotted ALOHA"):
        found["formula"] = slotted_aloha(load, AGENTS)
    elif scheme == "TDMA":
        found["formula"] = (AGENTS - 1) / AGENTS
    return found


def contention(
    scheme: str, load: float, seed: int, frames: int = _FRAMES["contended"]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What our side makes of a load of contenders, and the question to ns-3.

    :param scheme: one of CONTENDED.
    :param load: frames in the time of one, if senders never waited.
    :param seed: of the run.
    :param frames: of the run, about.
    """
    POLICIES.register("csma-ca", CsmaCa)
    period_ns, end_ns = AGENTS * _ON_AIR_NS / load, round(frames * _ON_AIR_NS / load)
    senders, count = range(2, AGENTS + 2), round(2 * end_ns / period_ns) + 50
    question = {"kind": "contend", "payload": _PAYLOAD, "signal": _SIGNAL, "end_ns": end_ns, "seed": seed}
    if scheme == "CSMA/CA":
        policy, options = "csma-ca", {
            "csma-ca.mean_ms": period_ns / 1e6,
            "csma-ca.min_be": _MIN_BE,
            "csma-ca.max_be": _MAX_BE,
            "csma-ca.backoffs": _BACKOFFS,
            "csma-ca.sent_ms": (_TURN_NS + _ON_AIR_NS) / 1e6,
        }  # fmt: skip
        waits = [waits_ns(seed, agent, period_ns, count).tolist() for agent in senders]
        question |= {"min_be": _MIN_BE, "max_be": _MAX_BE, "backoffs": _BACKOFFS}
    else:
        window_ns = 2**_FIXED_BE * BACKOFF_NS
        policy, options = "csma", {"csma.period_ms": period_ns / 1e6, "csma.window_ms": window_ns / 1e6}
        waits = [_periods_ns(seed, agent, period_ns, count) for agent in senders]
        question |= {"min_be": _FIXED_BE, "max_be": _FIXED_BE, "backoffs": _MOST_BACKOFFS}
    swarm = SwarmConfig(agents=AGENTS + 1, policy=policy, frame="extended", seed=seed, options=options)
    channel = ChannelConfig(agents=AGENTS + 1, slot_ns=swarm.slot_ns, bitrate=_BITRATE, ramp_up_ns=_TURN_NS)
    ours = contend(swarm, channel, -(-end_ns // swarm.slot_ns))
    figures = contended(ours.sent, ours.heard, ours.given_up, on_air_ns=_ON_AIR_NS, end_ns=end_ns)
    if scheme != "CSMA/CA":
        listened = ours.listened * _ON_AIR_NS / end_ns
        figures |= {"listened": listened, "formula": non_persistent_csma(listened, _TURN_NS / _ON_AIR_NS)}
    return figures, {**question, "waits_ns": waits}


def _periods_ns(seed: int, agent: int, period_ns: float, count: int) -> list[int]:
    """How long a sender of ns-3 waits after its last bit, that it begins as often as ``csma`` does."""
    random = np.random.default_rng([seed, 16, agent])
    between = (random.uniform(0.5, 1.5, count) * period_ns).astype(np.int64) - _TURN_NS - _ON_AIR_NS
    between[0] = random.uniform(0.0, period_ns)
    return np.maximum(1, between).tolist()


def _contend(scheme: str, load: float, seed: int) -> dict[str, Any]:
    ours, question = contention(scheme, load, seed)
    answer = ask(question)
    theirs = contended(
        answer["sent"], answer["heard"], answer["given_up"], on_air_ns=_ON_AIR_NS, end_ns=question["end_ns"]
    )
    found = {"scheme": scheme, "load": load, "ns3": answer["version"], "ours": ours, "theirs": theirs}
    if scheme == "CSMA/CA":
        for what, mine, other, limit in (
            ("throughput", ours["throughput"], theirs["throughput"], _SAME_THROUGHPUT),
            ("mean wait", ours["wait_ms"]["mean"], theirs["wait_ms"]["mean"], _SAME_WAIT),
        ):
            if abs(mine - other) > limit * other:
                raise NotMet(f"{what}: {mine:.4g}, of ns-3 {other:.4g}")
    return found


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    found = [row["summary"] for row in rows]
    return {
        "ns3": sorted({row["ns3"] for row in found}),
        "carried": [row for row in found if row["scheme"] in CARRIED],
        "contended": [row for row in found if row["scheme"] in CONTENDED],
    }


SOAK = Soak(
    "ns3",
    "Frames that begin at the same instants are received by the same agents on the simulated channel and in ns-3, for "
    "ALOHA, slotted ALOHA, TDMA and CSMA, with all in range and with hidden senders. Where both contend for themselves "
    "by CSMA/CA of IEEE 802.15.4, throughput is ns-3's to 2 % and the mean wait to 4 %.",
    _items(),
    _run,
    _figures,
    check,
)
