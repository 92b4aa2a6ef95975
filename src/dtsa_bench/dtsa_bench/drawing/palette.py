"""The colours of everything that shows a swarm: report page, pictures, layouts, RViz markers.

An agent has one colour everywhere, by its id, on light and on dark paper. Any two of the twelve stay apart for readers
with normal sight, deuteranopia, protanopia and tritanopia (Machado, Oliveira, Fernandes 2009); a test measures that.
Standard library only: the script that writes the layouts runs without the workspace.
"""

from __future__ import annotations

# Petroff's sequence of ten ("Accessible Color Sequences for Data Visualization", arXiv:2107.02270) without its two
# greys, which would be taken for agents that hover; and the four colours that a search found farthest from these and
# from each other.
AGENT_COLOURS = (
    "#3f90da", "#ffa90e", "#bd1f01", "#832db6", "#92dadd", "#e76300", "#b9ac70", "#a96b59",
    "#4b00f0", "#960069", "#d25a96", "#964bff",
)  # fmt: skip
# From the 13th agent on colours come again, with another dash and another shape.
DASHES = ((), (5, 2), (1.5, 1.8), (6, 1.5, 1.5, 1.5))  # lengths drawn and left out, in line widths
SHAPES = ("circle", "diamond", "square", "triangle")
HOVERING = "#98a3af"
# Lines, bars and areas that are no agents: Okabe and Ito ("Color Universal Design", 2008).
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
# Outcome of a slot or a frame.
SENT, COLLIDED = "#e69f00", "#dc183c"


def agent_colour(agent: int) -> str:
    """The colour of an agent.

    :param agent: id, from 1.
    :returns: ``#rrggbb``.
    """
    return AGENT_COLOURS[(agent - 1) % len(AGENT_COLOURS)]


def agent_turn(agent: int) -> int:
    """How often the colours were used up before this agent (id, from 1): index into `DASHES` and `SHAPES`."""
    return (agent - 1) // len(AGENT_COLOURS) % len(SHAPES)


def rgb(colour: str) -> tuple[float, float, float]:
    """Red, green and blue of ``#rrggbb``, sRGB, 0 to 1."""
    red, green, blue = (int(colour[start : start + 2], 16) / 255 for start in (1, 3, 5))
    return red, green, blue


def luminance(colour: str) -> float:
    """Relative luminance of ``#rrggbb``, 0 (black) to 1 (white)."""
    linear = (part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in rgb(colour))
    red, green, blue = linear
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def ink_on(colour: str) -> str:
    """Colour of text that can be read on another one, ``#rrggbb``."""
    return "#10151b" if luminance(colour) > 0.2 else "#ffffff"
