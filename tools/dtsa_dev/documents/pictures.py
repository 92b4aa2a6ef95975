"""The pictures of the explanation pages, drawn from slots that the protocol core really plays.

`python -m dtsa_dev.documents.pictures DIR` writes them as SVG. They stand on a light ground of their own, so that they
can be read on a dark page, and their letters are large enough for a telephone.
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
    """An SVG that grows downwards.

    :param title: what the picture shows, in a few words.
    """

    title: str
    height: float = 64.0
    parts: list[str] = field(default_factory=list)

    def rectangle(self, x: float, y: float, width: float, height: float, fill: str, edge: str = "none") -> None:
        """A box with round corners; lengths in px."""
        box = f"x='{x:g}' y='{y:g}' width='{width:g}' height='{height:g}'"
        self.parts.append(f"<rect {box} rx='5' fill='{fill}' stroke='{edge}' stroke-width='2'/>")

    def text(self, x: float, y: float, words: str, size: int = TEXT, ink: str = INK, anchor: str = "start") -> None:
        """One line of text.

        :param x: px, of what the anchor names: start, middle or end.
        :param y: px, of its base line.
        """
        place = f"x='{x:g}' y='{y:g}' font-size='{size}' fill='{ink}' text-anchor='{anchor}'"
        self.parts.append(f"<text {place}>{escape(words)}</text>")

    def line(self, x1: float, y1: float, x2: float, y2: float, ink: str = QUIET, arrow: bool = False) -> None:
        """A straight line, with a head at its end if it is an arrow; px."""
        head = " marker-end='url(#head)'" if arrow else ""
        ends = f"x1='{x1:g}' y1='{y1:g}' x2='{x2:g}' y2='{y2:g}'"
        self.parts.append(f"<line {ends} stroke='{ink}' stroke-width='2.5'{head}/>")

    def words(self, lines: list[str], ink: str = INK, size: int = TEXT) -> None:
        """Lines of text below what is there."""
        for line in lines:
            self.height += size * 1.45
            self.text(24, self.height, line, size, ink)
        self.height += 10

    def svg(self) -> str:
        """The whole picture."""
        height = self.height + 20
        return "\n".join([
            f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {height:g}' {_FONT} role='img'>",
            f"<title>{escape(self.title)}</title>",
            "<defs><marker id='head' viewBox='0 0 10 10' refX='8' refY='5' markerWidth='6' markerHeight='6' "
            f"orient='auto'><path d='M0 0L10 5L0 10z' fill='{QUIET}'/></marker></defs>",
            f"<rect width='{WIDTH}' height='{height:g}' rx='12' fill='{PAPER}' stroke='{GRID}'/>",
            f"<text x='24' y='42' font-size='{TITLE}' font-weight='bold' fill='{INK}'>{escape(self.title)}</text>",
            *self.parts,
            "</svg>",
            "",
        ])  # fmt: skip


@dataclass(frozen=True, slots=True)
class Slot:
    """What happened in one slot."""

    number: int
    senders: tuple[int, ...]  # ids
    taken: tuple[int, ...]  # whom each agent takes for the sender, 0: nobody
    why: str  # reason of the first sender


def slots(config: SwarmConfig, count: int, lost: tuple[int, int] = (-1, 0)) -> tuple[list[Slot], list[bool]]:
    """Plays a swarm from slot 0 on.

    :param config: the swarm.
    :param count: number of slots.
    :param lost: slot, and id of the agent that does not receive its frame.
    :returns: the slots, and which agents move.
    """
    swarm = Swarm(config)
    played = []
    for number in range(count):
        swarm.scenario.advance(number, swarm)
        senders = [(swarm.ids[index], swarm.frame(index)) for index in swarm.begin(number)]
        ids = tuple(agent for agent, _ in senders)
        why = REASONS[int(swarm.reason[ids[0] - 1])] if ids else ""
        played.append(Slot(number, ids, tuple(int(agent) for agent in swarm.chosen), why))
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
    played, moving = slots(SwarmConfig(agents=agents, moving=2, policy="lease", seed=4), agents * rounds)
    drawing = Drawing("lease: how slots are given away")
    flying = " and ".join(f"cf{k + 1}" for k, moves in enumerate(moving) if moves)
    drawing.words([f"A row is a round, a column the slots of one owner. {flying} fly.",
                   "The number says who sends; the word says by what right."])  # fmt: skip
    left, cell, row = 100.0, 100.0, 62.0
    top = drawing.height + 34
    for owner in range(1, agents + 1):
        drawing.text(left + (owner - 0.5) * cell, top - 12, f"cf{owner}", TEXT, INK, "middle")
    for slot in played:
        x, y = left + slot.number % agents * cell, top + slot.number // agents * row
        if slot.number % agents == 0:
            drawing.text(24, y + 38, f"round {slot.number // agents}", SMALL, QUIET)
        if not slot.senders:
            drawing.rectangle(x + 3, y + 3, cell - 6, row - 6, PAPER, HOVERING)
            drawing.text(x + cell / 2, y + 36, "OPEN", SMALL, QUIET, "middle")
            continue
        sender = slot.senders[0]
        fill = agent_colour(sender) if moving[sender - 1] else "#c3ccd6"
        drawing.rectangle(x + 3, y + 3, cell - 6, row - 6, fill)
        drawing.text(x + cell / 2, y + 29, str(sender), TEXT, ink_on(fill), "middle")
        drawing.text(x + cell / 2, y + 50, slot.why, SMALL, ink_on(fill), "middle")
    drawing.height = top + rounds * row
    drawing.words(["Round 0: all send once. In its own frame each agent that rests",
                   "names who gets its next slots (leased); it says nothing more until",
                   "its next anchor. OPEN: kept free for an agent that gets a new goal."])  # fmt: skip
    return drawing


def lost_frame() -> Drawing:
    """What each of eight agents takes for the next sender, before and after one of them misses a frame."""
    agents, missed, by, first, count = 8, 183, 8, 182, 17
    config = SwarmConfig(agents=agents, moving=agents, policy="dtsa", scenario="waypoints", stops=4, seed=2)
    played, _ = slots(config, first + count, (missed, by))
    shown = played[first:]
    drawing = Drawing("DTSA: what one lost frame does")
    drawing.words(["A row is an agent, a column a slot: whom that agent takes",
                   "for the sender. All must agree, or two send, or nobody does."])  # fmt: skip
    left, cell = 76.0, 36.0
    top = drawing.height + 34
    for column, slot in enumerate(shown):
        x = left + column * cell
        if column % 4 == 0:
            drawing.text(x + 2, top - 10, str(slot.number), SMALL, QUIET)
        for agent, taken in enumerate(slot.taken):
            y = top + agent * cell
            fill = agent_colour(taken) if taken else PAPER
            drawing.rectangle(x + 2, y + 2, cell - 4, cell - 4, fill, "none" if taken else HOVERING)
            drawing.text(x + cell / 2, y + 25, str(taken or "–"), SMALL, ink_on(fill) if taken else QUIET, "middle")
        y = top + agents * cell + 16
        if len(slot.senders) == 1:
            fill = agent_colour(slot.senders[0])
            drawing.rectangle(x + 2, y + 2, cell - 4, cell - 4, fill)
            drawing.text(x + cell / 2, y + 25, str(slot.senders[0]), SMALL, ink_on(fill), "middle")
        else:
            drawing.rectangle(x + 2, y + 2, cell - 4, cell - 4, COLLIDED if slot.senders else PAPER, COLLIDED)
            ink = ink_on(COLLIDED) if slot.senders else COLLIDED
            drawing.text(x + cell / 2, y + 25, str(len(slot.senders)), SMALL, ink, "middle")
    for agent in range(1, agents + 1):
        drawing.text(24, top + (agent - 1) * cell + 25, f"cf{agent}", SMALL)
    drawing.text(24, top + agents * cell + 41, "sent", SMALL)
    x, y = left + (missed - first) * cell, top + (by - 1) * cell
    drawing.rectangle(x - 1, y - 1, cell + 2, cell + 2, "none", COLLIDED)
    drawing.height = top + (agents + 1) * cell + 16
    both = sum(len(slot.senders) > 1 for slot in shown)
    silent = sum(not slot.senders for slot in shown)
    spoilt = sum(len(slot.senders) != 1 for slot in slots(config, first + count)[0][first:])
    sender = shown[missed - first].senders[0]
    drawing.words([f"In slot {missed} cf{by} misses the frame of cf{sender}. Its table differs from now on,",
                   f"and so do its choices. Of {count} slots, {both} hold two frames that",
                   f"collide and {silent} stay empty. Without the loss: {spoilt or 'none'}."])  # fmt: skip
    return drawing


_STEPS = (
    ("The agent decides", "From its own table: who sends in slot i? (core/swarms, libdtsa)"),
    ("The codec encodes its state", "19, 26 or 56 bytes, rounded (libdtsa/frame.c)"),
    ("The key seals the frame", "With --auth: a tag of 4 bytes over session, slot and frame"),
    ("The channel carries it", "Air time, overlap, range, loss (dtsa_channel_sim/model)"),
    ("The receivers take it in", "They check, decode and change their tables; bad frames are counted"),
    ("The recorder keeps it", "Frame, receivers, decisions and true states, in an MCAP bag"),
    ("verify computes it again", "Every decision and every verdict, compared bit by bit"),
)


def life_of_a_frame() -> Drawing:
    """The way of a frame from an agent's decision into a bag that is verified."""
    drawing = Drawing("The life of a frame")
    height, gap = 62.0, 30.0
    y = drawing.height + 8
    for index, (step, detail) in enumerate(_STEPS):
        fill = agent_colour(1) if index < 3 else agent_colour(2) if index == 3 else "#dfe4ea"
        drawing.rectangle(24, y, WIDTH - 48, height, fill)
        ink = ink_on(fill)
        drawing.text(40, y + 27, step, TEXT, ink)
        drawing.text(40, y + 50, detail, SMALL, ink)
        if index:
            drawing.line(WIDTH / 2, y - gap + 2, WIDTH / 2, y - 5, arrow=True)
        y += height + gap
    drawing.height = y - gap
    return drawing


PICTURES = {"lease-turns": lease, "lost-frame": lost_frame, "life-of-a-frame": life_of_a_frame}


def main(arguments: list[str]) -> int:
    """Writes all pictures into a directory."""
    if len(arguments) != 1:
        print(__doc__, file=sys.stderr)
        return 2
    for name, draw in PICTURES.items():
        path = Path(arguments[0]) / f"{name}.svg"
        path.write_text(draw().svg(), encoding="utf-8")
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
