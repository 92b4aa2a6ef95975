"""Whether an entry is what its flights say: its digest, seeds and sums, and a sample of flights flown again."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import POLICIES
from dtsa_bench.experiments.batch.pool import run_all

from .cells import JUDGED, League, check_scheme
from .entrant import package_of
from .entry import FIELDS, digest_of, is_complete, listed
from .plan import EntryPlan, Wanted, work_of
from .scores import summary_of

SHOWN = 10  # differences that are named; the others are counted


@dataclass(frozen=True, slots=True)
class Checked:
    """What a check found."""

    flown: int  # flights flown again
    of: int  # flights of the entry
    differences: tuple[str, ...]  # what is wrong with the entry
    notes: tuple[str, ...]  # what is not wrong, and ought to be known


def check_entry(
    there: League, entry: Mapping[str, Any], *, word: str | None, sample: int | None, seed: int, jobs: int | None
) -> Checked:
    """Checks an entry.

    :param there: its league.
    :param entry: the entry.
    :param word: the practice word or the secret, from which its seeds must follow; None: it is not known yet.
    :param sample: flights that are flown again; None: all.
    :param seed: decides which.
    :param jobs: number of processes; None: one a core.
    :raises ConfigError: if its policy is not here.
    """
    differences = [*sums(there, entry), *_seeds(there, entry, word)]
    policy = entry["scheme"].get("policy")
    if policy not in POLICIES.rows and policy not in POLICIES.plug_in_names():
        raise ConfigError(
            "ENTRY", policy, "an entry whose policy is installed; --package flies that of a folder or wheel"
        )
    check_scheme(entry["scheme"])
    work = work_of(entry["scheme"]["policy"])
    notes = _notes(entry, work.code(), word)
    lines = {(cell, line[0]): line for cell, part in entry["flights"].items() for line in part}
    chosen = _sample(entry, sample, seed)
    plan = EntryPlan(there, entry["name"], entry["scheme"], chosen)
    rows = run_all(plan, work, jobs=jobs)
    for wanted in plan.flights:
        again = listed(wanted, rows[plan.key(wanted)])
        differences += _differences(wanted, lines[wanted.cell, wanted.k], again)
    return Checked(len(plan.flights), len(lines), tuple(differences), tuple(notes))


def _sample(entry: Mapping[str, Any], sample: int | None, seed: int) -> list[Wanted]:
    flights = [Wanted(cell, line[0], line[1]) for cell, lines in entry["flights"].items() for line in lines]
    flights = list({(wanted.cell, wanted.k): wanted for wanted in flights}.values())
    if sample is None or sample >= len(flights):
        return flights
    return random.Random(seed).sample(flights, sample)


def sums(there: League, entry: Mapping[str, Any]) -> list[str]:
    """Numbers of an entry that do not follow from its rows.

    :param there: its league.
    :param entry: the entry.
    """
    found = []
    if digest_of(entry) != entry["digest"]:
        found.append("digest: not that of what the entry says: something in it was changed")
    complete = is_complete(there, entry["flights"])
    if entry["complete"] != complete:
        found.append(f"complete: {entry['complete']}; by its rows {complete}")
    found += _unequal("summary", entry["summary"], summary_of(there, entry["flights"]))
    for cell, lines in entry["flights"].items():
        numbers = [line[0] for line in lines]
        if len(set(numbers)) < len(numbers) or not all(0 <= k < there.count for k in numbers):
            found.append(f"flights.{cell}: numbers of seeds that are double, or not 0 to {there.count - 1}")
    return found


def _unequal(name: str, said: Any, made: Any) -> list[str]:
    """Places where two nested values differ; numbers must be equal to the last bit but for rounding of sums."""
    if isinstance(said, Mapping) and isinstance(made, Mapping):
        keys = [*made, *(key for key in said if key not in made)]
        return [text for key in keys for text in _unequal(f"{name}.{key}", said.get(key), made.get(key))]
    if isinstance(said, float) and isinstance(made, float) and math.isclose(said, made, rel_tol=1e-12):
        return []
    same_kind = isinstance(said, bool) == isinstance(made, bool)
    return [] if said == made and same_kind else [f"{name}: {said}; by its rows {made}"]


def _seeds(there: League, entry: Mapping[str, Any], word: str | None) -> list[str]:
    found = []
    commitment = there.commitment if entry["seeds"] == JUDGED else None
    if entry["commitment"] != commitment:
        found.append(f"commitment: {entry['commitment']}; of {there.name} with {entry['seeds']} seeds {commitment}")
    if word is None:
        return found
    for cell, lines in entry["flights"].items():
        for line in lines:
            seed = there.seed(word, cell, line[0])
            if line[1] != seed:
                found.append(f"{cell}/{line[0]}: seed {line[1]}; it must be {seed}")
    return found


def _notes(entry: Mapping[str, Any], code: str, word: str | None) -> list[str]:
    notes = []
    if word is None:
        notes.append("the secret is not published yet: whether the seeds follow from it was not checked")
    made = entry["made_with"].get("code")
    if made != code:
        notes.append(f"flown by other code ({made}, here {code}): equal flights say that it computes the same")
    policy = entry["scheme"]["policy"]
    if policy in POLICIES.rows or policy in POLICIES.plug_in_names():
        digest = package_of(policy)["digest"]
        if digest != entry["package"].get("digest"):
            notes.append(f"the policy's package, or its build, is another one here ({digest[:16]})")
    return notes


def _differences(wanted: Wanted, said: Sequence[Any], again: Sequence[Any]) -> list[str]:
    """Fields of a flight that differ when it is flown again."""
    named = zip(FIELDS, said, again, strict=True)
    return [
        f"{wanted.cell}/{wanted.k}: {field} {first}; flown again {second}"
        for field, first, second in named
        if first != second or isinstance(first, bool) != isinstance(second, bool)
    ]


def found_share(flights: int, changed: int, sample: int) -> float:
    """Probability that a sample has at least one of the changed flights.

    :param flights: of the entry.
    :param changed: how many of them are not as they were flown.
    :param sample: flights that are flown again.
    """
    return 1.0 - math.comb(flights - changed, sample) / math.comb(flights, sample) if sample <= flights else 1.0
