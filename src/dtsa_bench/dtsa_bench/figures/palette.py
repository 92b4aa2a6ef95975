"""The colours of the agents: the same agent has the same colour in pictures, pages and layouts.

Twelve colours, chosen by search so that any two of them, and each of them and the paper (light or dark), stay apart for
readers with normal sight, deuteranopia, protanopia and tritanopia (Machado, Oliveira, Fernandes 2009). From the
thirteenth agent on they repeat, which is why ids are written wherever there is room.
"""

from __future__ import annotations

AGENT_COLOURS = (
    "#0088ee", "#bb6611", "#771133", "#66ddcc", "#dd4488", "#003399",
    "#eebb44", "#662266", "#bbcc88", "#880000", "#ddaaff", "#aa7755",
)  # fmt: skip


def agent_colour(agent: int) -> str:
    """The colour of an agent, ``#rrggbb``.

    :param agent: its id, from 1.
    """
    return AGENT_COLOURS[(agent - 1) % len(AGENT_COLOURS)]


def luminance(colour: str) -> float:
    """Relative luminance of an sRGB colour, 0 (black) to 1 (white).

    :param colour: ``#rrggbb``.
    """
    parts = [int(colour[start : start + 2], 16) / 255 for start in (1, 3, 5)]
    red, green, blue = (part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def ink_on(colour: str) -> str:
    """Colour of text that can be read on another one.

    :param colour: ``#rrggbb`` of the ground.
    """
    return "#10151b" if luminance(colour) > 0.2 else "#ffffff"
