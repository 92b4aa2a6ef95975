"""Pictures of the explanation pages, drawn from slots that the protocol core really plays.

`python -m dtsa_dev.documents.pictures docs/images` writes them as SVG, on a light ground of their own, so that they can
be read on a dark page, with letters that are large enough for a telephone. (``life-of-a-frame.svg`` was drawn by hand.)
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import numpy as np

from dtsa_agent.core import REASONS, Swarm, SwarmConfig
from dtsa_bench.drawing.palette import COLLIDED, HOVERING, agent_colour, ink_on
from dtsa_bench.drawing.style import GRID, INK, PAPER, QUIET

WIDTH = 720  # px; a telephone shows half of it
TITLE, TEXT, SMALL = 24, 19, 16  # px
_FONT = "font-family='DejaVu Sans, Verdana, sans-serif'"


@dataclass(slots=True)
class Drawing:
    """An SVG that grows downwards; lengths in px."""

    title: str
    height: float = 64.0
    parts: list[str] = field(default_factory=list)

    def box(self, x: float, y: float, width: float, height: float, fill: str, edge: str = "none") -> None:
        """A box with round corners."""
        place = f"x='{x:g}' y='{y:g}' width='{width:g}' height='{height:g}'"
        self.parts.append(f"<rect {place} rx='5' fill='{fill}' stroke='{edge}' stroke-width='2'/>")

    def text(self, x: float, y: float, words: str, size: int = TEXT, ink: str = INK, anchor: str = "start") -> None:
        """One line of text; the anchor says what of it is at x: its start or its middle."""
        place = f"x='{x:g}' y='{y:g}' font-size='{size}' fill='{ink}' text-anchor='{anchor}'"
        self.parts.append(f"<text {place}>{escape(words)}</text>")

    def cell(self, x: float, y: float, size: float, words: str, fill: str, edge: str = "none", ink: str = "") -> None:
        """A square with a few letters in its middle."""
        self.box(x + 2, y + 2, size - 4, size - 4, fill, edge)
        self.text(x + size / 2, y + 25, words, SMALL, ink or ink_on(fill), "middle")

    def words(self, *lines: str) -> None:
        """Lines of text below what is there."""
        for line in lines:
            self.height += TEXT * 1.45
            self.text(24, self.height, line)
        self.height += 10

    def svg(self) -> str:
        """The whole picture."""
        height = self.height + 20
        return "\n".join([
            f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {height:g}' {_FONT} role='img'>",
            f"<title>{escape(self.title)}</title>",
            f"<rect width='{WIDTH}' height='{height:g}' rx='12' fill='{PAPER}' stroke='{GRID}'/>",
            f"<text x='24' y='42' font-size='{TITLE}' font-weight='bold' fill='{INK}'>{escape(self.title)}</text>",
            *self.parts, "</svg>", "",
        ])  # fmt: skip


@dataclass(frozen=True, slots=True)
class PlayedSlot:
    """Events of one slot."""

    number: int
    senders: tuple[int, ...]  # ids
    chosen: tuple[int, ...]  # the sender as each agent computes it, 0: none
    reason: str  # of the first sender


def play(config: SwarmConfig, count: int, lost: tuple[int, int] = (-1, 0)) -> tuple[list[PlayedSlot], list[bool]]:
    """Play a swarm from slot 0 on: the slots, and which agents move.

    `lost` is a slot, and the id of the agent that does not receive its frame.
    """
    swarm = Swarm(config)
    played = []
    for number in range(count):
        swarm.scenario.advance(number, swarm)
        senders = [(swarm.ids[index], swarm.frame(index)) for index in swarm.begin(number)]
        ids = tuple(agent for agent, _ in senders)
        reason = REASONS[int(swarm.reason[ids[0] - 1])] if ids else ""
        played.append(PlayedSlot(number, ids, tuple(int(agent) for agent in swarm.chosen), reason))
        swarm.fly(number)
        if len(senders) == 1:
            received = np.ones(config.agents, dtype=np.uint8)
            if number == lost[0]:
                received[lost[1] - 1] = 0
            swarm.hear(number, senders[0][1], received)
        swarm.end(number)
    return played, [bool(moves) for moves in swarm.scenario.moving]


def lease() -> Drawing:
    """Rounds of six agents of which two fly: who owns a slot, and who sends in it."""
    agents, rounds = 6, 6
    played, moving = play(SwarmConfig(agents=agents, moving=2, policy="lease", seed=4), agents * rounds)
    drawing = Drawing("lease: how slots are given away")
    flying = " and ".join(f"cf{k + 1}" for k, moves in enumerate(moving) if moves)
    drawing.words(f"A row is a round, a column the slots of one owner. {flying} fly.",
                  "The number says who sends; the word says by what right.")  # fmt: skip
    left, cell, row = 100.0, 100.0, 62.0
    top = drawing.height + 34
    for owner in range(1, agents + 1):
        drawing.text(left + (owner - 0.5) * cell, top - 12, f"cf{owner}", TEXT, INK, "middle")
    for slot in played:
        x, y = left + slot.number % agents * cell, top + slot.number // agents * row
        if slot.number % agents == 0:
            drawing.text(24, y + 38, f"round {slot.number // agents}", SMALL, QUIET)
        if not slot.senders:
            drawing.box(x + 3, y + 3, cell - 6, row - 6, PAPER, HOVERING)
            drawing.text(x + cell / 2, y + 36, "OPEN", SMALL, QUIET, "middle")
            continue
        sender = slot.senders[0]
        fill = agent_colour(sender) if moving[sender - 1] else "#c3ccd6"
        drawing.box(x + 3, y + 3, cell - 6, row - 6, fill)
        drawing.text(x + cell / 2, y + 29, str(sender), TEXT, ink_on(fill), "middle")
        drawing.text(x + cell / 2, y + 50, slot.reason, SMALL, ink_on(fill), "middle")
    drawing.height = top + rounds * row
    drawing.words("Round 0: all send once. In its own frame each agent that rests",
                  "names who gets its next slots (leased); it says nothing more until",
                  "its next anchor. OPEN: kept free for an agent that gets a new goal.")  # fmt: skip
    return drawing


def lost_frame() -> Drawing:
    """The next sender by each of eight agents, before and after one of them misses a frame."""
    agents, missed, by, first, count, cell = 8, 183, 8, 182, 17, 36.0
    config = SwarmConfig(agents=agents, moving=agents, policy="dtsa", scenario="waypoints", stops=4, seed=2)
    shown = play(config, first + count, (missed, by))[0][first:]
    drawing = Drawing("DTSA: what one lost frame does")
    drawing.words("A row is an agent, a column a slot: the agent that it takes",
                  "for the sender. All must agree, or two send, or none does.")  # fmt: skip
    left, top = 76.0, drawing.height + 34
    for column, slot in enumerate(shown):
        x = left + column * cell
        if column % 4 == 0:
            drawing.text(x + 2, top - 10, str(slot.number), SMALL, QUIET)
        for row, agent in enumerate(slot.chosen):
            y = top + row * cell
            if agent:
                drawing.cell(x, y, cell, str(agent), agent_colour(agent))
            else:
                drawing.cell(x, y, cell, "–", PAPER, HOVERING, QUIET)
        y = top + agents * cell + 16
        if len(slot.senders) == 1:
            drawing.cell(x, y, cell, str(slot.senders[0]), agent_colour(slot.senders[0]))
        else:
            fill, ink = (COLLIDED, "") if slot.senders else (PAPER, COLLIDED)
            drawing.cell(x, y, cell, str(len(slot.senders)), fill, COLLIDED, ink)
    for agent in range(1, agents + 1):
        drawing.text(24, top + (agent - 1) * cell + 25, f"cf{agent}", SMALL)
    drawing.text(24, top + agents * cell + 41, "sent", SMALL)
    drawing.box(left + (missed - first) * cell - 1, top + (by - 1) * cell - 1, cell + 2, cell + 2, "none", COLLIDED)
    drawing.height = top + (agents + 1) * cell + 16
    both, silent = sum(len(slot.senders) > 1 for slot in shown), sum(not slot.senders for slot in shown)
    spoilt = sum(len(slot.senders) != 1 for slot in play(config, first + count)[0][first:])
    sender = shown[missed - first].senders[0]
    drawing.words(f"In slot {missed} cf{by} misses the frame of cf{sender}. Its table differs from now on,",
                  f"and so do its choices. Of {count} slots, {both} hold two frames that",
                  f"collide and {silent} stay empty. Without the loss: {spoilt or 'none'}.")  # fmt: skip
    return drawing


PICTURES = {"lease-turns": lease, "lost-frame": lost_frame}


if __name__ == "__main__":
    for name, draw in PICTURES.items():
        (Path(sys.argv[1]) / f"{name}.svg").write_text(draw().svg(), encoding="utf-8")
