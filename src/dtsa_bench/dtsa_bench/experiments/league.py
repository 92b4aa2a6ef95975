"""The league: frozen cells that any policy flies, entries that anybody can check, and the table of all.

The frozen parts stand in ``league-1.yaml``; see docs/how-to/sweep.md.
"""

from __future__ import annotations

import hashlib
import json
import math
import random
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import POLICIES
from dtsa_agent.yaml_file import read_yaml
from dtsa_bench import __version__
from dtsa_bench.runs.options import write_whole

from .batch import FAILED, Batch, Row, Task, key_of, run_all
from .provenance import read_provenance
from .statistics import LEVEL, Share, wilson
from .sweep import cost_of, run_config
from .tables import share_texts

Entry = dict[str, Any]  # as its file has it: name, bound, scheme, package, commit, date, flights
#: A flight as an entry lists it; all but the status are None of one that could not be flown.
FIELDS = (
    "status", "slots", "completion_time_s", "waking_age_mean_ms", "age_mean_ms", "channel_load", "min_distance_m",
    "digest",
)  # fmt: skip
_AGE, _LOAD = FIELDS.index("waking_age_mean_ms"), FIELDS.index("channel_load")
#: Settings of an entry: its policy, that policy's own settings, the format of its frames.
SCHEME_SETTINGS = (
    "policy", "frame", "options", "gossip", "epsilon", "selection", "boot_round", "age_cap", "return_every",
    "anchor_every", "anchor_rest", "open_every", "adoption", "depth_rate", "lease_share",
)  # fmt: skip
#: Below a table: what the star at a rank means.
STAR = "* Flown by looking into all agents, in place of what a radio would have to tell."
HEADS = ("rank", "scheme", "lost", "crashed", "out of time", "age, ms", "on the air", "worst cell")
_SHORTEST, _STEP_NS = "shortest", 10_000  # slots as short as the frames allow, rounded up
_LEAST_AGE_MS = 0.01  # smaller ages count as this one: their logarithm is taken
_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,39}")


class League:
    """A league as its file says it."""

    def __init__(self, content: Mapping[str, Any]) -> None:
        self.name, self.title, self.entrants = content["name"], content["title"], content["entrants"]
        self.cells: dict[str, dict[str, Any]] = content["cells"]  # text, settings and lost_age_ms by name
        self.seed_count: int = content["seeds"]["count"]  # of each cell
        self._content = {key: content[key] for key in ("name", "seeds", "shortest", "base", "cells")}
        text = json.dumps(self._content, sort_keys=True)
        self.digest = hashlib.sha256(text.encode()).hexdigest()[:16]  # of all that is frozen

    def seed(self, cell: str, k: int) -> int:
        """Seed k of a cell: the first 31 bits of SHA-256("WORD/CELL/k")."""
        word = self._content["seeds"]["word"]
        return int.from_bytes(hashlib.sha256(f"{word}/{cell}/{k}".encode()).digest()[:4], "big") >> 1

    def settings(self, cell: str, scheme: Mapping[str, Any], seed: int) -> dict[str, Any]:
        """Return the settings of a flight by flat names.

        :raises ConfigError: if the policy cannot fly the cell.
        """
        settings = {**self._content["base"], **self.cells[cell]["settings"], **scheme, "seed": seed}
        if settings["slot_ms"] == _SHORTEST:
            run, shortest = run_config({**settings, "slot_ms": 10}), self._content["shortest"]
            needs_frame = run.swarm.policy_row.needs_frame
            guard_ns, decide_ns = (round(shortest[part] * 1e6) for part in ("guard_ms", "decide_ms"))
            slot_ns = run.air.airtime.shortest_slot_ns(
                run.swarm.frame_length,
                guard_ns=guard_ns,
                decide_ns=decide_ns if needs_frame else 0,
                needs_frame=needs_frame,
            )
            settings["slot_ms"] = -(-slot_ns // _STEP_NS) * _STEP_NS / 1e6
        return settings


@cache
def league(name: str = "league-1") -> League:
    """Return a league that comes with the package."""
    return League(read_yaml(Path(__file__).resolve().with_name(f"{name}.yaml"), "league"))


# -- entries -----------------------------------------------------------------------------------------------------------
def make_entry(the_league: League, what: str, name: str | None, changes: Mapping[str, Any]) -> Entry:
    """Return an entry without flights of a scheme that comes with the package, or of a policy; `changes` win.

    :raises ConfigError: for a policy that does not exist, and what an entry may not set.
    """
    own = the_league.entrants.get(what, {"policy": what})
    scheme = {key: value for key, value in own.items() if key != "bound"} | dict(changes)
    if what not in the_league.entrants and what not in POLICIES.rows and what not in POLICIES.plug_in_names():
        names = sorted({*the_league.entrants, *POLICIES.plug_in_names()})
        raise ConfigError("POLICY", what, f"{', '.join(names)}, or a plug-in that --path finds")
    check_scheme(scheme)
    chosen = name or what
    if not _NAME.fullmatch(chosen):
        raise ConfigError("name", chosen, "lower-case letters, digits, dots and hyphens, 40 at most")
    needs_everybody = POLICIES.row(scheme["policy"]).needs_everybody
    bound = bool(own.get("bound", needs_everybody and what not in the_league.entrants))
    provenance, plug_in = read_provenance(), POLICIES.plug_ins().get(scheme["policy"])
    package = f"{plug_in.dist.name} {plug_in.dist.version}" if plug_in and plug_in.dist else f"dtsa {__version__}"
    commit = provenance["commit"][:9] + (" with changes" if provenance["tree_changed"] else "")
    described = {"package": package, "commit": commit, "date": provenance["date"][:10]}
    return {"name": chosen, "bound": bound, "scheme": scheme, **described, "flights": {}}


def check_scheme(scheme: Mapping[str, Any]) -> None:
    """Raise ConfigError for what an entry may not set, and for a policy that is not here."""
    policy = scheme["policy"]
    for key, value in scheme.items():
        if key not in SCHEME_SETTINGS:
            raise ConfigError(f"set.{key}", value, ", ".join(SCHEME_SETTINGS[1:]))
    for key, value in dict(scheme.get("options", {})).items():
        if not str(key).startswith(f"{policy}."):
            raise ConfigError(f"set.options.{key}", value, f"options of the policy: {policy}.NAME")
    POLICIES.row(policy)


def batch_of(the_league: League, entry: Entry, wanted: Iterable[tuple[str, int]]) -> Batch:
    """Return flights of an entry as a batch; what is wanted are cells and numbers of seeds."""
    scheme, tasks = entry["scheme"], []
    policy = scheme["policy"]
    for cell, k in wanted:
        seed = the_league.seed(cell, k)
        settings = {"league": the_league.name, "frozen": the_league.digest, "cell": cell, "k": k, "scheme": scheme}
        tasks.append(Task(key_of(settings), 0, seed, settings, cost_of(the_league.settings(cell, scheme, seed))))
    plug_ins = frozenset() if policy in POLICIES.rows else frozenset({("policy", policy)})
    return Batch(f"{the_league.name} {entry['name']}", tasks, fly, plug_ins)


def fly(task: Task) -> tuple[str, Row]:
    """Fly one run of a league; return how it ended, and the values of :data:`FIELDS`.

    The digest is the first 64 bits of SHA-256 over senders, outcomes and true positions of all slots.
    """
    from dtsa_bench.simulation.simulate import simulate

    cell, scheme = task.settings["cell"], task.settings["scheme"]
    flight = simulate(run_config(league(task.settings["league"]).settings(cell, scheme, task.seed)), log=True)
    summary, log = flight.summary(), flight.log
    assert log is not None
    digest = hashlib.sha256(json.dumps([list(ids) for ids in log.senders()]).encode())
    digest.update(log.outcome.tobytes())
    digest.update(log.position.astype("<f8", copy=False).tobytes())
    values = {**summary, "slots": summary["slots"]["total"], "digest": digest.hexdigest()[:16]}
    return summary["end"], {name: values[name] for name in FIELDS[1:]}


def flight_of(row: Row) -> list[Any]:
    """Return the row of a batch as an entry lists it, in the order of :data:`FIELDS`."""
    values = row["summary"] or dict.fromkeys(FIELDS)
    return [row["status"], *(values[name] for name in FIELDS[1:])]


def is_complete(the_league: League, entry: Entry) -> bool:
    """Whether all seeds of all cells were flown."""
    return all(len(entry["flights"].get(cell, ())) == the_league.seed_count for cell in the_league.cells)


def write_entries(path: Path, the_league: League, entries: Sequence[Entry]) -> None:
    """Write entries to one file, the flights of a cell in a line."""
    head = {"league": the_league.name, "frozen": the_league.digest, "fields": FIELDS}
    texts = []
    for entry in entries:
        lines = [f"   {json.dumps(c)}: {json.dumps(f, separators=(',', ':'))}" for c, f in entry["flights"].items()]
        start = json.dumps({**entry, "flights": {}}).removesuffix("{}}")
        texts.append(f"  {start}{{\n" + ",\n".join(lines) + "\n  }}")
    start = json.dumps({**head, "entries": []}).removesuffix("]}")
    write_whole(path, f"{start}\n" + ",\n".join(texts) + "\n ]}\n")


def read_entries(path: str | Path) -> list[Entry]:
    """Return the entries in a file, or in that of a directory that `league enter` wrote.

    :raises ConfigError: if it has none, or of other cells than the league has here.
    """
    file = Path(path) / "entry.json" if Path(path).is_dir() else Path(path)
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        the_league, entries = league(content["league"]), content["entries"]
        if not entries or (content["frozen"], content["fields"]) != (the_league.digest, list(FIELDS)):
            raise ValueError("no entries, or other cells or columns than here")
        for entry in entries:
            texts = all(isinstance(text, str) for text in (entry["name"], entry["scheme"]["policy"]))
            for cell, flights in entry["flights"].items():
                fits = cell in the_league.cells and len(flights) <= the_league.seed_count
                if not texts or not fits or not all(map(_is_flight, flights)):
                    raise ValueError(f"{entry['name']}: {cell}: not the flights of a cell")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError("FILE", str(path), f"entries of a league, JSON ({error})") from error
    return list(entries)


def _is_flight(flight: Sequence[Any]) -> bool:
    status, *numbers, digest = flight
    finite = all(isinstance(n, (int, float)) and math.isfinite(n) for n in numbers if n is not None)
    return finite and len(flight) == len(FIELDS) and isinstance(status, str) and isinstance(digest, (str, type(None)))


def check_entry(
    the_league: League, entry: Entry, *, sample: int | None, seed: int, jobs: int | None
) -> tuple[int, list[str]]:
    """Fly a sample of an entry's flights again (None: all); return how many, and each value that differs.

    :raises ConfigError: if its policy is not here.
    """
    check_scheme(entry["scheme"])
    flights = {(cell, k): flight for cell, lines in entry["flights"].items() for k, flight in enumerate(lines)}
    chosen = list(flights) if sample is None else random.Random(seed).sample(list(flights), min(sample, len(flights)))
    batch = batch_of(the_league, entry, chosen)
    rows = run_all(batch, jobs=jobs)
    differences = []
    for (cell, k), task in zip(chosen, batch.tasks, strict=True):
        for field, recorded, recomputed in zip(FIELDS, flights[cell, k], flight_of(rows[task.key]), strict=True):
            if recorded != recomputed or isinstance(recorded, bool):
                differences.append(f"{entry['name']}: {cell}/{k}: {field} {recorded}; flown again {recomputed}")
    return len(chosen), differences


# -- scores ------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Scores:
    """Score of some flights. A lost flight crashed, did not end in time or could not be flown."""

    lost: Share
    crashed: int
    timed_out: int
    failed: int
    age_ms: tuple[float, float, float]  # geometric mean, cells weighing the same; its 95 % interval, NaN of one seed
    load: float  # share of time on the air; not a number if nothing could be flown


def scores(the_league: League, flights: Mapping[str, Sequence[Sequence[Any]]]) -> Scores:
    """Return the scores of flights by cell."""
    ends = [flight[0] for lines in flights.values() for flight in lines]
    ages = [
        np.log([_age_ms(flight, float(the_league.cells[cell]["lost_age_ms"])) for flight in lines])
        for cell, lines in flights.items()
    ]
    loads = [[flight[_LOAD] for flight in lines if flight[_LOAD] is not None] for lines in flights.values()]
    means = [np.mean(part) for part in loads if part]
    mean = float(np.mean([part.mean() for part in ages]))
    variances = [float(part.var(ddof=1) / len(part)) if len(part) > 1 else math.nan for part in ages]
    half = NormalDist().inv_cdf(0.5 + LEVEL / 2) * math.sqrt(sum(variances)) / len(ages)
    return Scores(
        wilson(len(ends) - ends.count("completed"), len(ends)),
        ends.count("crashed"),
        ends.count("timed out"),
        ends.count(FAILED),
        (math.exp(mean), math.exp(mean - half), math.exp(mean + half)),
        float(np.mean(means)) if means else math.nan,
    )


def _age_ms(flight: Sequence[Any], most: float) -> float:
    """Age of a flight, as it counts; `most` is that of a lost one, and the largest."""
    lost = flight[0] != "completed" or flight[_AGE] is None
    return most if lost else min(most, max(_LEAST_AGE_MS, float(flight[_AGE])))


class LeagueTable:
    """Entries beside each other: the order is by lost flights times age, bounds at the end.

    :raises ConfigError: if entries have not flown the same, or have the same name.
    """

    def __init__(self, the_league: League, entries: Sequence[Entry]) -> None:
        names = [entry["name"] for entry in entries]
        flown = [{cell: len(lines) for cell, lines in entry["flights"].items()} for entry in entries]
        for number, name in enumerate(names):
            if name in names[:number]:
                raise ConfigError("FILE", name, "every name once; `league enter --name` gives another one")
            if flown[number] != flown[0] or not any(flown[0].values()):
                most, fewest = sorted((0, number), key=lambda each: sum(flown[each].values()), reverse=True)
                raise ConfigError(
                    "FILE",
                    names[fewest],
                    f"entries with flights, in the same cells and as many as {names[most]}; "
                    "`league enter` without --cells and --sample flies all",
                )
        self.league = the_league
        self.cells = [cell for cell in the_league.cells if flown[0].get(cell)]
        total = {entry["name"]: scores(the_league, entry["flights"]) for entry in entries}

        def order(entry: Entry) -> tuple[bool, float, float, str]:
            score = total[entry["name"]]
            return bool(entry["bound"]), score.lost.count * score.age_ms[0], score.age_ms[0], entry["name"]

        self.entries = sorted(entries, key=order)  # the best first
        self.scores = [total[entry["name"]] for entry in self.entries]
        self.by_cell = [
            {cell: scores(the_league, {cell: entry["flights"][cell]}) for cell in self.cells} for entry in self.entries
        ]

    @property
    def complete(self) -> bool:
        """Whether all entries have flown all."""
        return all(is_complete(self.league, entry) for entry in self.entries)

    def lines(self, dash: str = "–") -> list[list[str]]:
        """Return a line an entry, in the columns of :data:`HEADS`; `dash` is between the ends of intervals."""
        lines = []
        for rank, (entry, total, cells) in enumerate(zip(self.entries, self.scores, self.by_cell, strict=True), 1):
            worst = max(cells, key=lambda name: self._badness(name, cells[name]))
            count, percent = share_texts(total.lost, dash)
            age, *ends = map(figure, total.age_ms)
            interval = "" if math.isnan(total.age_ms[1]) else f" ({dash.join(ends)})"
            not_flown = f" + {total.failed} not flown" if total.failed else ""
            lines.append(
                [
                    "bound" if entry["bound"] else f"{rank}*" if _sees_everything(entry) else str(rank),
                    entry["name"],
                    f"{count} ({percent})",
                    str(total.crashed),
                    f"{total.timed_out}{not_flown}",
                    f"{age}{interval}",
                    percent_text(total.load),
                    f"{worst}: {cells[worst].lost}, {figure(cells[worst].age_ms[0])} ms",
                ]
            )
        return lines

    def _badness(self, cell: str, score: Scores) -> tuple[float, float]:
        """Order of cells: share of lost flights, then age for that of lost ones."""
        return score.lost.value, score.age_ms[0] / self.league.cells[cell]["lost_age_ms"]

    def cell_lines(self) -> list[list[str]]:
        """Return a line an entry: of each cell age in ms, and in brackets lost flights, if any."""
        return [
            [entry["name"], *(figure(s.age_ms[0]) + (f" ({s.lost})" if s.lost.count else "") for s in cells.values())]
            for entry, cells in zip(self.entries, self.by_cell, strict=True)
        ]


def _sees_everything(entry: Entry) -> bool:
    """Whether the simulator flies the entry by looking into all agents; unknown plug-ins do not count."""
    policy = entry["scheme"]["policy"]
    here = policy in POLICIES.rows or policy in POLICIES.plug_in_names()
    return here and POLICIES.row(policy).needs_everybody


def percent_text(share: float) -> str:
    """Return a share in percent; a dash: there is none."""
    return "–" if math.isnan(share) else f"{100 * share:.2f} %"


def figure(value: float) -> str:
    """Return a number with three digits."""
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"
