"""The paper's experiment, twelve that exchange their places, from apps on board, beside the simulator and UDP."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_bench.crazyflies.peer_lab.app import LabSettings
from dtsa_bench.crazyflies.peer_lab.onboard import HEIGHT_M, OnBoard
from dtsa_bench.experiments.batch.task import Row
from dtsa_bench.experiments.statistics import wilson
from dtsa_bench.recordings.bag.run import load_run
from dtsa_bench.recordings.merge.agent_bag import read
from dtsa_bench.recordings.merge.merge import Merge, verified
from dtsa_bench.recordings.merge.merged_run import lay
from dtsa_bench.recordings.merge.merged_writer import write
from dtsa_bench.recordings.tables.ages import follow_run
from dtsa_bench.runs.config import RunConfig, RunLimits, from_swarm
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim import ChannelConfig
from dtsa_dev.network.trial import WHOLE, NotFlown, Trial, fly

from .checks import met
from .item import Item, NotMet, Soak

AGENTS = 12
SCHEMES: dict[str, dict[str, Any]] = {
    "TDMA, hold": {"policy": "tdma", "estimator": "hold"},
    "TDMA, linear": {"policy": "tdma"},
    "DTSA, linear": {"policy": "dtsa"},
    "lease": {"policy": "lease"},
}
LOSSES = (0.0, 0.05, 0.1)
BOARD, UDP, SIMULATOR = "board", "udp", "simulator"
EVENTS = {"kill": "one is switched off in flight", "late": "one is switched on late"}
_SEEDS, _UDP_SEEDS = (1, 2), (1, 2, 3)
_SIMULATED = 30
_ENABLE_S, _END_S = 6.0, 11.5
_UDP_S = 6.0
_SWITCHED = 12  # the agent of the events
_KILL_S = 7.5
_LATE_S, _LATE_UP_S, _LATE_GO_S, _LONG_END_S = 8.0, 10.5, 14.0, 21.0
_MOVED_M, _THERE_M = 0.05, 0.1
_MODES = ("off", "flies", "hovers", "lands")  # of the app: `dtsa.mode`
_SHOWN = ("age_mean_slots", "age_max_slots", "min_distance_m", "collided", "estimate_error_mean_m")


def _items() -> Iterator[Item]:
    """Flights of one seed first: half a record has all settings."""
    later = (*((BOARD, seed) for seed in _SEEDS[1:]), *((UDP, seed) for seed in _UDP_SEEDS[1:]))
    for form, seed in ((BOARD, _SEEDS[0]), (UDP, _UDP_SEEDS[0]), *later):
        for scheme in SCHEMES:
            for loss in LOSSES:
                if form == UDP and (scheme == "DTSA, linear" or loss == LOSSES[1]):
                    continue  # in real time; and agents on a network come late, but nobody can join DTSA
                settings = {"form": form, "scheme": scheme, "loss": loss}
                yield Item(f"{form}, {scheme}, {loss:.0%} lost, seed {seed}", settings, seed, 20.0,
                           sample=(form, seed, scheme, loss) == (BOARD, 1, "lease", 0.05))  # fmt: skip
        if form == BOARD and seed == _SEEDS[0]:
            for event, text in EVENTS.items():
                yield Item(text, {"form": BOARD, "scheme": "lease", "loss": 0.05, "event": event}, seed, 30.0)


def _run(item: Item, directory: Path) -> dict[str, Any]:
    swarm = SwarmConfig(agents=AGENTS, seed=item.seed, **SCHEMES[item.settings["scheme"]])
    loss, event = item.settings["loss"], item.settings.get("event", "")
    over_udp = item.settings["form"] == UDP
    found = _over_udp(swarm, loss, directory) if over_udp else _on_board(swarm, loss, directory, event)
    crash = found.pop("crash")
    figures = {**item.settings, "seed": item.seed, **found}
    if crash:
        raise NotMet(f"a crash: {crash}", figures)
    return figures


def _on_board(swarm: SwarmConfig, loss: float, directory: Path, event: str) -> dict[str, Any]:
    """A flight in the laboratory."""
    followed: list[dict[str, Any]] = []
    with OnBoard(swarm, LabSettings(seed=swarm.seed, loss=loss), directory, enable_s=_ENABLE_S) as flight:
        if event:
            _EVENTS[event](flight)
        for second in range(int(_ENABLE_S) + 1, int(_LONG_END_S)) if event else ():
            flight.lab.at(second, lambda: followed.append(_state(flight)))
        flight.lab.run(_LONG_END_S if event else _END_S)
        followed.append(_state(flight))
        lab = flight.finish()
    merged = Merge([read(path) for path in sorted(directory.glob("cf*.mcap"))])
    found = merged.judge()
    met(verified(found), f"the bags do not verify: {found['decisions_again']}, {found['turns']['which']}")
    figures = {
        "decisions_again": found["decisions_again"]["equal"],
        "two_senders_slots": found["turns"]["slots_with_two_senders"],
        "truth": {name: lab[name] for name in ("mean_age_ms", "min_distance_m", "crashed", "share_of_air", "away_m")},
        "by_time": followed,
    }
    met(found["common_slot"] is not None, "they never counted alike")
    if not event:
        write(directory / WHOLE, lay(merged, found), found)
        figures |= _judged(directory / WHOLE, swarm)
    crashed = set(lab["crashed"]) - ({_SWITCHED} if event == "kill" else set())  # without power it falls
    return {**figures, "crash": "" if swarm.policy == "dtsa" or not crashed else f"agents {sorted(crashed)}"}


def _state(flight: OnBoard) -> dict[str, Any]:
    """What each agent does at an instant, and how far each is from its goal."""
    lab, target = flight.lab, np.array(flight.scenario.target)
    away = np.sqrt(((lab.world.vehicles.position - target - np.array([[0.0], [0.0], [HEIGHT_M]])) ** 2).sum(axis=0))
    modes = ["off" if not lab.is_on(k) else _MODES[round(lab.log(k, "dtsa.mode"))] for k in range(1, AGENTS + 1)]
    whys = [round(lab.log(k, "dtsa.why")) if lab.is_on(k) else None for k in range(1, AGENTS + 1)]
    return {"time_s": lab.time, "modes": modes, "whys": whys, "away_m": [round(float(one), 2) for one in away]}


def _kill(flight: OnBoard) -> None:
    flight.lab.at(_KILL_S, lambda: flight.lab.switch_off(_SWITCHED))


def _late(flight: OnBoard) -> None:
    """It stays off from when the others are told what to do, and is prepared once it is on."""
    lab = flight.lab
    height = HEIGHT_M + float(flight.scenario.start[2, _SWITCHED - 1])

    def up() -> None:
        lab.take_off(_SWITCHED, height, 3.0)

    lab.at(lab.settings.boot_s + 0.05, lambda: lab.switch_off(_SWITCHED))
    lab.at(_LATE_S, lambda: lab.switch_on(_SWITCHED))
    lab.at(_LATE_S + 0.1, lambda: flight.prepare(_SWITCHED))
    lab.at(_LATE_UP_S, up)
    lab.at(_LATE_GO_S, lambda: lab.set_parameter(_SWITCHED, "dtsa.enable", 1))


_EVENTS: dict[str, Callable[[OnBoard], None]] = {"kill": _kill, "late": _late}


def _over_udp(swarm: SwarmConfig, loss: float, directory: Path) -> dict[str, Any]:
    """A flight of agents on hosts of their own, in real time."""
    trial = Trial(swarm, {"loss": loss}, seconds=_UDP_S, seed=swarm.seed)
    try:
        found = fly(trial, directory)
    except NotFlown as error:
        raise NotMet(str(error)) from error
    met(verified(found), f"the bags do not verify: {found['decisions_again']}, {found['turns']['which']}")
    met(found["flight"] is not None, "they never counted alike")
    flight = found["flight"]
    sent = found["frames_sent"] + found["frames_unsent"]
    return {
        "decisions_again": found["decisions_again"]["equal"],
        "unsent_share": found["frames_unsent"] / max(1, sent),
        "two_senders_slots": found["turns"]["slots_with_two_senders"],
        **_judged(directory / WHOLE, swarm),
        "crash": f"nearest pair {flight['min_distance_m']:.3f} m" if flight["collided"] else "",
    }


def _judged(bag: Path, swarm: SwarmConfig) -> dict[str, Any]:
    """Results of a merged flight, and its mean age from when the first one moves until all are there."""
    run = load_run(bag)
    followed = follow_run(run)
    met(followed.ages is not None and bool(followed.summary), f"nothing to judge: {followed.notes}")
    ages, position = followed.ages, run.motion.position
    assert ages is not None
    scenario = make_scenario(swarm)
    gone, away = (np.sqrt(((position - place[None]) ** 2).sum(axis=1)).max(axis=1)
                  for place in (np.array(scenario.start), np.array(scenario.target)))  # fmt: skip
    slots = np.arange(len(gone))
    together = slots[gone <= _MOVED_M]
    first = together[-1] + 1 if len(together) else 0
    last = slots[away > _THERE_M][-1]
    flew = bool(first < len(slots) and last >= first)
    if not flew:  # nobody left its place
        first, last = 0, len(slots) - 1
    weight = ages.observers * (ages.results & (slots >= first) & (slots <= last))[:, None]
    met(bool(weight.any()), "no slot with results")
    age = float((np.where(weight > 0, ages.age, 0.0) * weight).sum() / weight.sum())
    arrived = flew and bool(last < slots[-1])
    return {
        "age_slots": age,
        "arrived": arrived,
        "flight_s": float(last - first + 1) * swarm.slot_s if arrived else None,
        **{name: followed.summary[name] for name in _SHOWN},
    }


def simulated(scheme: str, loss: float, seed: int) -> dict[str, Any]:
    """The same flight in the simulator, with a Crazyflie's radio.

    :param scheme: a key of SCHEMES.
    :param loss: share of frames that a receiver loses.
    :param seed: of the flight.
    """
    swarm = SwarmConfig(agents=AGENTS, seed=seed, **SCHEMES[scheme])
    channel: dict[str, Any] = {"loss": loss, "radio": "crazyflie", **from_swarm(swarm)}
    limits = RunLimits(timeout_s=20.0, stop_on_crash=False)
    found = simulate(RunConfig(swarm, ChannelConfig(**channel), limits)).summary()
    return {"age_slots": found["age_mean_slots"], "flight_s": found["completion_time_s"], **found}


def _mean(rows: Sequence[dict[str, Any]], name: str) -> float | None:
    values = [row[name] for row in rows if row.get(name) is not None]
    return round(sum(values) / len(values), 4) if values else None


def _summed(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means and crashes of the flights of one form, scheme and loss."""
    share = wilson(sum(bool(row["collided"]) for row in rows), len(rows))
    return {
        "flights": len(rows),
        "crashed": str(share),
        "interval": [round(share.low, 3), round(share.high, 3)],
        **{name: _mean(rows, name) for name in ("age_slots", "flight_s", *_SHOWN[2:3], *_SHOWN[4:])},
        "min_distance_least_m": round(min(row["min_distance_m"] for row in rows), 3),
        "true_age_ms": _mean([row["truth"] for row in rows if "truth" in row], "mean_age_ms"),
    }


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    found: dict[str, Any] = {"agents": AGENTS, "slot_ms": 10, "simulated_seeds": f"1 to {_SIMULATED}", "cells": []}
    flights = [row["summary"] for row in rows]
    plain = [row for row in flights if not row.get("event")]
    for scheme in SCHEMES:
        for loss in LOSSES:
            cell = {
                form: _summed(some)
                for form in (BOARD, UDP)
                if (some := [r for r in plain if (r["form"], r["scheme"], r["loss"]) == (form, scheme, loss)])
            }
            if cell:
                cell[SIMULATOR] = _summed([simulated(scheme, loss, seed) for seed in range(1, _SIMULATED + 1)])
                found["cells"].append({"scheme": scheme, "loss": loss, **cell})
    found["decisions_again"] = sum(row["decisions_again"] for row in flights)
    found["events"] = {row["event"]: row for row in flights if row.get("event")}
    return found


SOAK = Soak(
    "twelve",
    "The paper's experiment from twelve apps on board in the peer-to-peer laboratory, beside the simulator with a "
    "Crazyflie's radio and agents over UDP: all decisions verify, and nobody crashes with TDMA and `lease`. When one "
    "is switched off in flight nobody else falls; when one is switched on late all fly.",
    tuple(_items()),
    _run,
    _figures,
)
