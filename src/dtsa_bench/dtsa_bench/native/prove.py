"""Policy ``lease`` explored state by state, on libdtsa's own code, and broken rules that the search must find."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from dtsa_agent.core.errors import DtsaError

from .library import HERE, LIBRARY, compile_program, sources, tool

LEASE = LIBRARY / "policy" / "lease"
_SPEED = "-O2"


@dataclass(frozen=True, slots=True)
class World:
    """What happens in an exploration; absence, M and S are small, because they only set time scales."""

    name: str
    agents: int
    anchor_every: int = 2  # M
    open_every: int = 0  # S
    adoption: bool = False
    patience: int = 6  # slots of silence after which an agent is thought absent
    restarts: int = 0
    deaths: int = 0
    returns: int = 0
    most_states: int = 4_000_000  # where the search gives up

    def words(self) -> list[str]:
        """Arguments of ``prove.c``."""
        times = (self.patience, self.restarts, self.deaths, self.returns, self.most_states)
        return [str(int(value)) for value in (self.agents, self.anchor_every, self.open_every, self.adoption, *times)]


@dataclass(frozen=True, slots=True)
class Explored:
    """What an exploration found."""

    world: World
    broken: str  # the rule; empty: all hold in all states that were reached
    states: int
    depth: int  # slots from the start
    closed: bool  # all reachable states were reached


WORLDS = (
    World("two agents", 2),
    World("two agents, a restart", 2, restarts=1),
    World("two agents, a restart, a death, a return", 2, restarts=1, deaths=1, returns=1),
    World("two agents, OPEN turns", 2, open_every=3),
    World("two agents, adoption, a death, a return", 2, adoption=True, deaths=1, returns=1),
    World("three agents, a restart", 3, restarts=1),
    World("three agents, adoption, a restart, a death", 3, adoption=True, restarts=1, deaths=1),
)


@dataclass(frozen=True, slots=True)
class Mutant:
    """One rule of the protocol broken, and a world in which that shows."""

    rule: str
    file: str  # below policy/lease
    right: str
    wrong: str
    world: World


_PLAIN, _RESTART = World("plain", 2), World("restart", 2, restarts=1)
_OPEN, _ADOPTS = World("open", 2, open_every=3), World("adopts", 2, adoption=True, deaths=1, returns=1)
MUTANTS = (
    Mutant(
        "who comes later begins in probation", "lease.c",
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
    Mutant("anchors are never given away", "lease.c", "if (anchor || (!i && !own))", "if (!i && !own)", _ADOPTS),
    Mutant("leases end at the next own anchor", "lease.c", "if (!i && anchor)", "if (0)", _RESTART),
    Mutant("OPEN turns are for who wakes", "lease.c", "if (v->a->woke < 0 || own_right", "if (own_right", _OPEN),
    Mutant(
        "who hears itself claimed goes into probation", "lease.c", "distance <= e->c_s || ", "", _ADOPTS,
    ),
    Mutant(
        "no adoption where it is switched off", "issue.c",
        "agent->table->config->lease.adoption && !v.a->probation", "!v.a->probation", World("dies", 2, deaths=1),
    ),
)  # fmt: skip


def build(directory: Path, lease: Path = LEASE) -> Path:
    """The explorer. What does not change from mutant to mutant is compiled once.

    :param directory: for the program and its parts.
    :param lease: folder of policy ``lease``.
    """
    compiler, parts = tool("gcc", "gcc"), directory / "parts"
    if not parts.is_dir():
        parts.mkdir()
        for path in [HERE / "prove.c", *sources(LIBRARY, without=["draw.c"])]:
            if path.parent != LEASE:
                out = parts / f"{path.parent.name}-{path.stem}.o"
                compile_program(compiler, out, [path], [_SPEED, "-c"], links=())
    files = [*sorted(lease.glob("*.c")), *sorted(parts.glob("*.o"))]
    return compile_program(compiler, directory / "prove", files, [_SPEED, f"-I{lease.parent}"])


def explore(program: Path, world: World, limit_s: float = 3600.0) -> Explored:
    """Explores a world.

    :param program: from :func:`build`.
    :param world: the world.
    :param limit_s: wall-clock time after which it is an error.
    :raises DtsaError: if the program fails.
    """
    command = [str(program), *world.words()]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=limit_s)
    found = re.search(r"(?:broken (.*); )?states (\d+) depth (\d+)(.*)", done.stdout)
    if found is None:
        raise DtsaError(f"prove: exit code {done.returncode}: {(done.stdout + done.stderr).strip()[-300:]}")
    return Explored(world, found[1] or "", int(found[2]), int(found[3]), "closed" in found[4])


def mutate(mutant: Mutant, directory: Path) -> Path:
    """An explorer in which one rule is broken.

    :param mutant: the rule.
    :param directory: for copy and program.
    :raises DtsaError: if the rule is not in the source any more.
    """
    copy = directory / "policy" / "lease"
    copy.parent.mkdir(exist_ok=True)
    shutil.copy(LEASE.parent / "policy.h", copy.parent)
    shutil.copytree(LEASE, copy, dirs_exist_ok=True)
    text = (copy / mutant.file).read_text(encoding="utf-8")
    if text.count(mutant.right) != 1:
        raise DtsaError(f"{mutant.rule}: {mutant.right!r} is not once in {mutant.file}")
    (copy / mutant.file).write_text(text.replace(mutant.right, mutant.wrong), encoding="utf-8")
    return build(directory, copy)
