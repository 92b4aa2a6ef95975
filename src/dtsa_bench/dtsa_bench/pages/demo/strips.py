"""Slots as coloured cells: who sent in each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dtsa_bench.drawing.palette import agent_colour

from .flown import Flown
from .story import KILLED

HOVER = "#c3ccd6"  # who hovers has nothing new to say
FIRST, COUNT = 100, 40  # the slots that are shown, well under way
ROUNDS = 16  # columns of each part around a death or a return


@dataclass(frozen=True, slots=True)
class Cell:
    """One slot."""

    x: int
    y: int
    colours: tuple[str, ...]  # one a sender; none: nobody sent
    label: str
    senders: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Part:
    """Some rounds of a flight, a column each; rows are the turns of the agents."""

    caption: str
    first: int  # round
    rounds: int
    cells: list[Cell]
    mark: float | None  # x at which it happens


def cell(flown: Flown, slot: int, x: int, y: int) -> Cell:
    """One slot of a flight as a cell at a place."""
    senders = flown.senders[slot] if slot < len(flown.senders) else ()
    colours = tuple(agent_colour(agent) if flown.moving[agent - 1] else HOVER for agent in senders)
    return Cell(x, y, colours, str(senders[0]) if len(senders) == 1 else "", senders)


def window(flights: Sequence[Flown]) -> tuple[int, int]:
    """First slot and number of slots that are shown of flights side by side."""
    shortest = min(len(flown.senders) for flown in flights)
    return min(FIRST, max(0, shortest - COUNT)), min(COUNT, shortest)


def cells(flown: Flown, first: int, count: int) -> list[Cell]:
    """Some slots in a row.

    :param flown: the flight.
    :param first: slot.
    :param count: of slots.
    """
    return [cell(flown, first + index, index, 0) for index in range(count)]


def killed_windows(flown: Flown) -> list[Part]:
    """The parts of the last flight that are shown: the death, the first use of its turns, the return.

    :param flown: the flight in which one is killed.
    """
    agents = flown.take.run.swarm.agents
    times = flown.times
    round_s = agents * flown.slot_s
    parts: list[Part] = []
    if times is None or times.killed_s is None:
        return parts
    last = len(flown.senders) // agents
    killed = times.killed_s / round_s
    parts.append(_part(flown, f"{KILLED} is killed", killed, last))
    turns = range(KILLED - 1, len(flown.senders), agents)
    after = [slot for slot in turns if slot > times.killed_s / flown.slot_s + agents]
    used = next((slot for slot in after if flown.senders[slot] and KILLED not in flown.senders[slot]), None)
    if used is not None:
        others = "/".join(str(agent) for agent in flown.senders[used])
        parts.append(_part(flown, f"its turns are used again, by {others}", used // agents, last))
    back = next((slot for slot in after if KILLED in flown.senders[slot]), None)
    if back is not None:
        parts.append(_part(flown, "it is back", back // agents, last))
    return parts


def _part(flown: Flown, caption: str, happens: float, last: int) -> Part:
    agents = flown.take.run.swarm.agents
    first = max(0, min(int(happens) - ROUNDS // 4, last - ROUNDS))
    shown = [
        cell(flown, (first + column) * agents + row, column, row) for column in range(ROUNDS) for row in range(agents)
    ]
    return Part(caption, first, ROUNDS, shown, happens - first)
