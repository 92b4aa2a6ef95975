"""The tables of the shortest slots, and of ages in them, in the documentation, made from the model.

A table stands between ``<!-- slots: NAME -->`` and ``<!-- end -->``; NAME is one of :data:`TABLES`. The command
``python -m dtsa_dev.documents.slot_lengths docs/*/*.md`` rewrites all tables of these files; for ``ages`` and
``ring`` it flies, some minutes.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import POLICIES
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_bench.experiments.sweep import spec
from dtsa_bench.experiments.sweep.aggregate import Group, Table, collected
from dtsa_bench.experiments.sweep.work import fly_one
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim import Airtime
from dtsa_channel_sim.model.airtime import RADIOS, Line

from .markdown import table

GUARD_NS = 70_000  # what clocks differ by that agents align at +-50 ppm and 20 % loss: docs/reference/protocol.md
# Most instructions of a slot of dtsa at N = 18 on a Cortex-M4F at 168 MHz: docs/evidence/embedded.md.
DECIDE_NS = {"dtsa": 780_000}
_RINGS = ((4, 0.0), (4, 0.05), (12, 0.0), (12, 0.05), (12, 0.2), (20, 0.0), (20, 0.05))
_RING_SEEDS = (1001, 1002, 1003)
CONSTANT = Line(300_000, 0, 300_000, 0)
_BLOCK = re.compile(r"(<!-- slots: (?P<name>[^>]*?) -->\n).*?(<!-- end -->)", re.DOTALL)


class Scheme(NamedTuple):
    """A policy with frames of some format.

    :param label: as in the table.
    :param policy: its name.
    :param frame: format of its frames.
    :param sealed: whether they are authenticated.
    """

    label: str
    policy: str
    frame: str
    sealed: bool = False

    @property
    def length(self) -> int:
        """Bytes of a frame."""
        return SwarmConfig(policy=self.policy, frame=self.frame, auth=self.sealed).frame_length


SCHEMES = (
    Scheme("tdma", "tdma", "paper"),
    Scheme("tdma, gossip", "tdma", "extended"),
    Scheme("lease", "lease", "extended"),
    Scheme("lease, sealed", "lease", "extended", True),
    Scheme("dtsa", "dtsa", "paper"),
    Scheme("dtsa, sealed", "dtsa", "paper", True),
    Scheme("dtsa, extended frame", "dtsa", "extended"),
    Scheme("dtsa, extended, sealed", "dtsa", "extended", True),
)


def rewritten(text: str, wanted: Sequence[str] = ("lengths", "ages", "ring")) -> str:
    """A page with its tables made again.

    :param text: the page, Markdown.
    :param wanted: names of the tables that are; others stay as they are.
    :raises ConfigError: if a table has a name that is none of :data:`TABLES`.
    """

    def renewed(found: re.Match[str]) -> str:
        name = found["name"]
        if name not in TABLES:
            raise ConfigError("slots", name, ", ".join(TABLES))
        if name not in wanted:
            return found[0]
        return f"{found[1]}{TABLES[name]()}{found[3]}"

    return _BLOCK.sub(renewed, text)


def shortest_ns(airtime: Airtime, scheme: Scheme) -> int:
    """The shortest slot of a scheme on a radio, ns.

    :param airtime: the radio's times.
    :param scheme: the scheme.
    """
    needs, decide_ns = POLICIES.row(scheme.policy).needs_frame, DECIDE_NS.get(scheme.policy, 0)
    return airtime.shortest_slot_ns(scheme.length, guard_ns=GUARD_NS, decide_ns=decide_ns, needs_frame=needs)


def lengths() -> str:
    """The parts of the shortest slots on a Crazyflie's radio, and what a constant 0.3 ms would make of them."""
    rows = []
    for bitrate in (2_000_000, 1_000_000):
        airtime = replace(RADIOS["crazyflie"].airtime, bitrate=bitrate)
        for scheme in SCHEMES if bitrate == 2_000_000 else (SCHEMES[0], SCHEMES[2], SCHEMES[4]):
            length, needs = scheme.length, POLICIES.row(scheme.policy).needs_frame
            rows.append(
                (
                    f"nRF51, {bitrate // 1_000_000} Mbit/s",
                    f"{scheme.label}, {length}",
                    _ms(airtime.ramp_up_ns),
                    _ms(airtime.on_air_ns(length)),
                    f"2 x {_ms(GUARD_NS)}",
                    _ms(airtime.from_radio_ns(length)),
                    _ms(DECIDE_NS.get(scheme.policy, 0)) if needs else "",
                    _ms(airtime.to_radio_ns(length)) if needs else "",
                    f"**{shortest_ns(airtime, scheme) / 1e6:.2f} ms**",
                    f"{shortest_ns(replace(airtime, line=CONSTANT), scheme) / 1e6:.2f} ms",
                )
            )
    heads = ("radio", "policy, bytes", "turn-round", "frame", "guard", "from the radio", "decision", "to the radio",
             "shortest slot", "with a constant 0.3 ms each way")  # fmt: skip
    return table(heads, rows)


def ages(**changes: Any) -> str:
    """Mean ages in the preset's flights, ms, and how many of them crashed.

    :param changes: of the sweep, see :func:`~dtsa_bench.experiments.sweep.spec.load_preset`.
    """
    sweep = spec.load_preset("crazyflie-radio", **changes)
    flown = Table(sweep, collected(sweep, {task.key: fly_one(task) for task in sweep.tasks()}))
    swarms, losses, schemes = (flown.levels(axis) for axis in sweep.axes)
    columns = [(swarm, lost) for swarm in swarms for lost in losses]
    rows = []
    for scheme in schemes:
        cells = [flown.select(dict(zip(sweep.axes, (*column, scheme), strict=True)))[0] for column in columns]
        rows.append((scheme, f"{cells[0].cell.settings['slot_ms']:g} ms", *map(_age, cells)))
    heads = ("scheme", "slot", *(f"{swarm}; {lost} lost" for swarm, lost in columns))
    return table(heads, rows)


def _age(group: Group) -> str:
    age, crashed = group.mean("age_mean_ms").value, group.crashed
    text = f"{age:.1f}" if age < 99.5 else f"{age:.0f}"
    return f"{text} ({crashed.count}/{crashed.total})" if crashed.count else text


def _ms(time_ns: int) -> str:
    return f"{time_ns / 1e6:.4f}".rstrip("0").rstrip(".") + " ms"


def ring(rows: Sequence[tuple[int, float]] = _RINGS) -> str:
    """The token ring behind the lines of Crazyflies beside TDMA, flights of 10 ms slots.

    :param rows: agents, and share of frames lost.
    """
    lines = []
    for agents, loss in rows:
        cells = [f"{agents}, {f'{100 * loss:g} %' if loss else 'none'}"]
        for policy in ("dtr", "tdma"):
            own = {"radio": "crazyflie", "options": {"dtr.react_ms": 0.0}} if policy == "dtr" else {}
            settings = {"agents": agents, "loss": loss, "policy": policy, **own}
            flown = [simulate(spec.run_config({**settings, "seed": seed})).summary() for seed in _RING_SEEDS]
            age_ms, load, packets = (
                sum(summary[name] for summary in flown) / len(flown)
                for name in ("age_mean_ms", "channel_load", "frames_per_s")
            )
            cells += [f"{age_ms:.1f}" if age_ms < 9.95 else f"{age_ms:.0f}", f"{100 * load:.1f} %"]
            if policy == "dtr":
                crashed = sum(summary["collided"] for summary in flown)
                cells += [f"{packets:.0f}", f"{crashed}/{len(flown)}"]
        lines.append(cells)
    heads = ("agents, frames lost", "`dtr`: mean age, ms", "time on the air", "packets/s", "crashes",
             "`tdma`: mean age, ms", "time on the air")  # fmt: skip
    return table(heads, lines)


TABLES: dict[str, Callable[[], str]] = {"lengths": lengths, "ages": ages, "ring": ring}


def main(paths: Sequence[str]) -> int:
    """Rewrites pages."""
    for name in paths:
        path = Path(name)
        path.write_text(rewritten(path.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
