"""`dtsa prove`: policy ``lease`` explored state by state, on libdtsa's own code; broken rules must be found."""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from dtsa_agent.core.errors import DtsaError
from dtsa_bench.commands.registry import Command
from dtsa_dev.proofs.programs import HERE, LIBRARY, compile_program, sources, tool

_SPEED = "-O2"
ANY = -1  # any number of times
# Not explored as they fly: whom a turn is worth most to (any of those able may get it, or nobody, also when it is
# handed on), and which are OPEN.
_CHOICE, _FREE_CHOICE = "(choose_lessee(v, candidates, turn) + 1)", "(prove_lessee(candidates->able, v->n) + 1)"
_OPEN_TURN, _FREE_OPEN_TURN = "mine && is_open(v, candidates, turn)", "mine && prove_open()"
_NEXT, _FREE_NEXT = "choose_next_lessee(v, &candidates, idle, turn)", "prove_next(candidates.able, v->self, v->n)"
_LAST, _EACH = "turn < last + !idle;", "turn <= last;"
_REACH = "RELAY_REACH = 24"
_HEADER = '#include "lease.h"\n'
_DECLARED = (
    "int prove_lessee(const uint8_t *able, int count);\nint prove_open(void);\n"
    "int prove_next(const uint8_t *able, int self, int count);\n"
)


@dataclass(frozen=True, slots=True)
class Scope:
    """Events of an exploration; M and S are small, because they only set time scales."""

    name: str
    agents: int
    anchor_every: int = 2  # M
    anchor_rest: int = 1  # K
    open_every: int = 0  # S; which turns are OPEN is free where it is not 0
    adoption: bool = False
    restarts: int = ANY
    deaths: int = ANY  # or leaving
    returns: int = ANY
    claims: int = ANY  # that somebody is dead, whether it is or not
    relay_reach: int = 24  # slots; with 1 all turns that an agent hands on are far ones
    most_states: int = 40_000_000  # where the search gives up

    def words(self) -> list[str]:
        """Arguments of ``prove.c``."""
        budgets = (self.restarts, self.deaths, self.returns, self.claims, self.most_states)
        rounds = (self.anchor_every, self.anchor_every * self.anchor_rest)
        return [str(int(value)) for value in (self.agents, *rounds, self.open_every, self.adoption, *budgets)]


@dataclass(frozen=True, slots=True)
class Exploration:
    """Result of an exploration."""

    scope: Scope
    broken: str  # the rule; empty: all hold in all states that were reached
    states: int
    depth: int  # slots from the start
    closed: bool  # all reachable states were reached


_ONCE = {"restarts": 1, "deaths": 1, "returns": 1}
_NEVER = {"restarts": 0, "deaths": 0, "returns": 0, "claims": 0}
SCOPES = (
    Scope("two agents", 2),
    Scope("two agents, OPEN turns", 2, open_every=3),
    Scope("two agents, adoption", 2, adoption=True),
    Scope("two agents, OPEN turns, adoption", 2, open_every=3, adoption=True),
    Scope("two agents, OPEN turns, adoption, K = 2", 2, anchor_rest=2, open_every=3, adoption=True, **_ONCE, claims=2),
    Scope("three agents", 3),
    Scope("three agents, M = 3", 3, anchor_every=3),
    Scope("three agents, adoption", 3, adoption=True),
    Scope("three agents, OPEN turns", 3, open_every=4),
    Scope("three agents, OPEN turns, adoption; each befalls once", 3, open_every=4, adoption=True, **_ONCE, claims=1),
    Scope(
        "three agents, OPEN turns, adoption, handed on far ahead", 3, open_every=4, adoption=True, restarts=1, deaths=0,
        returns=0, claims=1, relay_reach=1,
    ),
    Scope(
        "four agents, OPEN turns, adoption: chains of hand-ons; bounded", 4, open_every=5, adoption=True, **_NEVER,
        most_states=1_000_000,
    ),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Mutant:
    """One rule of the protocol broken, and a scope in which that shows."""

    rule: str
    file: str  # below policy/lease
    right: str
    wrong: str
    scope: Scope


_PLAIN, _RESTART = Scope("plain", 2, restarts=0, deaths=0), Scope("restart", 2, restarts=1, deaths=0)
_RESTS = Scope("rests", 2, anchor_rest=2, open_every=1, adoption=True, restarts=1, deaths=0)
_OPEN, _ADOPTS = Scope("open", 2, open_every=3, deaths=0), Scope("adopts", 2, adoption=True)
_HANDS = Scope("hands on", 3, open_every=4, adoption=True, **_NEVER)
_RELAYS = Scope("relays", 3, anchor_every=3, open_every=4, adoption=True, **_NEVER, most_states=10**6)
MUTANTS = (
    Mutant(
        "an agent that comes later begins in probation", "lease.c",
        "    a->probation = 1;\n    a->woke = slot;", "    a->woke = slot;", _RESTART,
    ),
    Mutant(
        "probation lasts until an own anchor is over", "lease.c",
        "!a->probation || !a->anchored", "!a->probation", _RESTART,
    ),
    Mutant("in probation anchors only", "lease.c", "if (anchor || !a->probation) return", "return", _RESTART),
    Mutant(
        "an owner is silent in a turn that it gave away", "lease.c",
        "if (given == LEASE_NONE) return", "if (given == LEASE_NONE || slot % v.n == self) return", _PLAIN,
    ),
    Mutant(
        "others' anchors are not given away", "lease.c",
        "if (i ? lease_is_anchor(v, turn) : !own)", "if (!i && !own)", _ADOPTS,
    ),
    Mutant(
        "leases end at the next own main anchor", "lease.c", "if (!i && lease_is_main(v, turn))", "if (0)", _RESTART,
    ),
    Mutant(
        "probation lasts until an own main anchor is over", "lease.c",
        "== agent->self && lease_is_main(", "== agent->self && lease_is_anchor(",
        _RESTS,
    ),
    Mutant(
        "OPEN turns are for agents that wake", "lease.c",
        "if (v->a->woke < 0 || has_own_turn", "if (has_own_turn", _OPEN,
    ),
    Mutant(
        "an agent that hears itself claimed goes into probation", "lease.c", "distance <= e->c_s || ", "", _ADOPTS,
    ),
    Mutant(
        "an agent in probation claims no other one dead", "issue.c",
        "lease.adoption && !v.a->probation && ", "lease.adoption && ", _ADOPTS,
    ),
    Mutant(
        "what others relay changes no entry", "lease.c", "} else if (sender == *known) {", "} else if (1) {", _RELAYS,
    ),
    Mutant(
        "no turn is handed on to its owner", "issue.c",
        "if (k < 0 || k == turn % v->n) continue;", "if (k < 0) continue;", _HANDS,
    ),
    Mutant(
        "no adoption where it is switched off", "issue.c",
        "agent->table->config->lease.adoption && !v.a->probation", "!v.a->probation", Scope("dies", 2),
    ),
    Mutant(
        "an owner does not change what its lessee has handed on", "lease.c", "!from_me && issuer", "issuer", _RELAYS,
    ),
)  # fmt: skip


class ProveCommand(Command):
    description = """\
Runs libdtsa's own code for policy lease through the states that two or three agents can reach, for all patterns of
loss, and checks the protocol's invariants in each; then breaks one rule at a time and sees that the search finds it."""
    examples = (("", "all scopes, then the broken rules"), ("--mutants", "the broken rules only"))

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--mutants", action="store_true", help="the broken rules only")

    def run(self, args: argparse.Namespace) -> int:
        """Explore."""
        import tempfile

        failed = 0
        with tempfile.TemporaryDirectory() as directory:
            for scope in () if args.mutants else SCOPES:
                result = explore(build(Path(directory), relay_reach=scope.relay_reach), scope)
                failed += bool(result.broken)
                end = result.broken or ("all states" if result.closed else "holds so far, not all states")
                print(f"{scope.name:62} {result.states:9} states, depth {result.depth:3}: {end}", flush=True)
            for mutant in MUTANTS:
                result = explore(build(Path(directory), mutant), mutant.scope)
                failed += not result.broken
                print(f"without {mutant.rule!r}: {result.broken or 'NOT FOUND'}; {result.states} states", flush=True)
        return 1 if failed else 0


def build(directory: Path, mutant: Mutant | None = None, relay_reach: int = 24) -> Path:
    """Compile the explorer, in a directory with a copy of the library. Parts that no mutant changes are compiled once.

    A relay speaks of `relay_reach` slots, 1 to 24.
    """
    compiler, library = tool("gcc", "gcc"), directory / f"libdtsa-{relay_reach}"
    parts, lease = library / "parts", library / "policy" / "lease"
    if not library.is_dir():
        shutil.copytree(LIBRARY, library)
        _replace(library / "frame.h", _REACH, f"RELAY_REACH = {relay_reach}")
        parts.mkdir()
        for path in [HERE / "prove.c", *sources(library, without=["draw.c"])]:
            if path.parent != lease:
                out = parts / f"{path.parent.name}-{path.stem}.o"
                compile_program(compiler, out, [path], [_SPEED, "-c"], library, links=())
    shutil.copytree(LIBRARY / "policy" / "lease", lease, dirs_exist_ok=True)
    _replace(lease / "issue.c", _CHOICE, _FREE_CHOICE)
    _replace(lease / "issue.c", _OPEN_TURN, _FREE_OPEN_TURN)
    _replace(lease / "issue.c", _NEXT, _FREE_NEXT)
    _replace(lease / "issue.c", _LAST, _EACH)
    _replace(lease / "issue.c", _HEADER, f"{_HEADER}{_DECLARED}")
    if mutant is not None:
        _replace(lease / mutant.file, mutant.right, mutant.wrong)
    files = [*sorted(lease.glob("*.c")), *sorted(parts.glob("*.o"))]
    return compile_program(compiler, library / "prove", files, [_SPEED], library)


def _replace(path: Path, right: str, wrong: str) -> None:
    text = path.read_text(encoding="utf-8")
    if text.count(right) != 1:
        raise DtsaError(f"{right!r} is not once in {path.name}")
    path.write_text(text.replace(right, wrong), encoding="utf-8")


def explore(program: Path, scope: Scope, limit_s: float = 3600.0) -> Exploration:
    """Explore a scope, within a limit of wall-clock time."""
    command = [str(program), *scope.words()]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=limit_s)
    match = re.search(r"(?:broken (.*); )?states (\d+) depth (\d+)(.*)", done.stdout)
    if match is None:
        raise DtsaError(f"prove: exit code {done.returncode}: {(done.stdout + done.stderr).strip()[-300:]}")
    return Exploration(scope, match[1] or "", int(match[2]), int(match[3]), "closed" in match[4])
