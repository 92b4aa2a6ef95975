"""The demo's moving picture: four flights side by side, slot by slot; who flies where, and who sends."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from dtsa_bench.drawing.palette import AGENT_COLOURS, COLLIDED, HOVERING, agent_colour, ink_on

from .flown import Flights, Flown
from .strips import HOVER
from .text import age, error

WIDTH, ROW, TOP = 880, 142, 66  # pixels
FIRST, SLOTS = 100, 132  # the slots that are shown, one a frame
FRAME_MS, LAST_MS = 90, 3500
_FINE = 2  # drawn so many times as large, then reduced
_ACROSS = 44  # cells in a line of a strip
_CELL, _LINE, _STRIP_X, _STRIP_Y = 16, 22, 160, 52
_VIEW = 128
_SAME = 255  # index of pixels that are as in the frame before
_INK, _MUTED, _PAPER, _BAD, _RULE, _NONE = "#16202c", "#5a6778", "#ffffff", COLLIDED, "#dfe4ea", "#c3ccd6"


@dataclass(frozen=True, slots=True)
class _Row:
    key: str
    name: str
    says: str  # a sentence
    value: str


def _rows(flights: Flights) -> list[_Row]:
    """What each row shows and says."""
    two, lost = "two-{}".format, "loss-{}".format
    return [
        _Row(two("tdma"), "TDMA", "All speak in turn, also the ten that hover and have nothing new to say.",
             f"positions are {age(flights[two('tdma')])} old"),
        _Row(two("dtsa"), "DTSA", "All compute whose state is most urgent: the two that fly speak.",
             f"positions are {age(flights[two('dtsa')])} old"),
        _Row(lost("dtsa"), "DTSA, 1 message in 10 lost", "They no longer know the same: two speak at once, or nobody.",
             f"positions are wrong by {error(flights[lost('dtsa')])}"),
        _Row(lost("lease"), "lease, 1 message in 10 lost", "Who hovers lends its turns, so only one can speak.",
             f"positions are wrong by {error(flights[lost('lease')])}"),
    ]  # fmt: skip


class _Pen:
    """Draws on an image in its own pixels; the image is `_FINE` times as large."""

    def __init__(self, image: Image.Image) -> None:
        self._draw = ImageDraw.Draw(image)
        self._fonts: dict[tuple[int, bool], ImageFont.FreeTypeFont] = {}

    def _font(self, size: int, bold: bool) -> ImageFont.FreeTypeFont:
        if (size, bold) not in self._fonts:
            name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
            place = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name
            self._fonts[size, bold] = ImageFont.truetype(str(place), size * _FINE)
        return self._fonts[size, bold]

    def text(
        self, x: float, y: float, text: str, size: int, colour: str, bold: bool = False, at: str = "lt", halo: str = ""
    ) -> None:
        font = self._font(size, bold)
        self._draw.text(
            (x * _FINE, y * _FINE),
            text,
            font=font,
            fill=colour,
            anchor=at,
            stroke_width=_FINE if halo else 0,
            stroke_fill=halo or None,
        )

    def box(self, x: float, y: float, width: float, height: float, fill: str | None, edge: str | None = None) -> None:
        corner = (x * _FINE, y * _FINE, (x + width) * _FINE - 1, (y + height) * _FINE - 1)
        self._draw.rectangle(corner, fill=fill, outline=edge, width=_FINE)

    def dot(
        self, x: float, y: float, radius: float, fill: str | None, edge: str | None = None, thick: float = 1
    ) -> None:
        corner = ((x - radius) * _FINE, (y - radius) * _FINE, (x + radius) * _FINE, (y + radius) * _FINE)
        self._draw.ellipse(corner, fill=fill, outline=edge, width=round(thick * _FINE))

    def line(self, points: list[tuple[float, float]], colour: str, thick: float) -> None:
        self._draw.line([(x * _FINE, y * _FINE) for x, y in points], fill=colour, width=round(thick * _FINE))


def draw_animation(path: Path, flights: Flights, slots: int = SLOTS) -> None:
    """Draws the moving picture as GIF.

    :param path: file to write.
    :param flights: the demo's flights.
    :param slots: how many of them are shown, one a frame.
    """
    rows = _rows(flights)
    size = WIDTH, TOP + ROW * len(rows)
    still = Image.new("RGB", (size[0] * _FINE, size[1] * _FINE), _PAPER)
    _ground(_Pen(still), rows)
    palette = _palette()
    frames: list[Image.Image] = []
    last = np.full((size[1], size[0], 3), -1)
    for frame in range(slots):
        pen = _Pen(still)
        for index, row in enumerate(rows):
            _cell(pen, flights[row.key], FIRST + frame, frame, TOP + ROW * index)
        image = still.copy()
        pen = _Pen(image)
        for index, row in enumerate(rows):
            _swarm(pen, flights[row.key], FIRST + frame, TOP + ROW * index)
        small = np.asarray(image.resize(size, Image.Resampling.BOX), dtype=np.int64)
        frames.append(_indexed(small, (small != last).any(axis=2), palette))
        last = small
    times = [FRAME_MS] * (slots - 1) + [LAST_MS]
    more: dict[str, Any] = {"transparency": _SAME, "disposal": 1, "loop": 0, "optimize": False}
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=times, **more)


def _indexed(pixels: NDArray[np.int64], new: NDArray[np.bool_], palette: NDArray[np.int64]) -> Image.Image:
    """A frame in the colours of the palette; what is as in the frame before is transparent, which packs well.

    :param pixels: (height, width, 3) red, green, blue.
    :param new: (height, width) where it differs from the frame before.
    :param palette: (P, 3) red, green, blue.
    """
    codes, places = np.unique(pixels[new] @ [65536, 256, 1], return_inverse=True)
    colours = np.stack((codes >> 16, codes >> 8 & 255, codes & 255), axis=1)
    nearest = ((colours[:, None] - palette[None]) ** 2).sum(axis=2).argmin(axis=1)
    index = np.full(new.shape, _SAME, dtype=np.uint8)
    index[new] = nearest[places]
    image = Image.fromarray(index, "P")
    image.putpalette([int(value) for value in palette.ravel()])
    return image


def _palette() -> NDArray[np.int64]:
    """All colours of the picture, and their mixtures with paper and ink for smooth edges, (255, 3)."""

    def mixed(colour: str, ground: str, *parts: float) -> list[NDArray[np.float64]]:
        one, other = (np.array([int(c[start : start + 2], 16) for start in (1, 3, 5)], float) for c in (colour, ground))
        return [other + (one - other) * part for part in parts]

    found = mixed(_PAPER, _PAPER, 1)
    for colour in (*AGENT_COLOURS, _BAD, HOVER, HOVERING):
        found += mixed(colour, _PAPER, 1, 0.75, 0.5, 0.25) + mixed(colour, ink_on(colour), 0.66, 0.33)
    for colour in (_INK, _MUTED, _RULE, _NONE):
        found += mixed(colour, _PAPER, *(part / 6 for part in range(1, 7)))
    palette = np.round(found).astype(np.int64)
    assert len(palette) <= _SAME
    return np.concatenate((palette, np.repeat(palette[:1], _SAME - len(palette), axis=0)))


def _ground(pen: _Pen, rows: list[_Row]) -> None:
    """What does not move."""
    pen.text(14, 14, "Twelve quadcopters, one radio channel: who speaks next?", 18, _INK, bold=True)
    reading = "A cell is a slot of 10 ms, its number says who sends in it. Grey: that one hovers. White: nobody sends."
    pen.text(14, 40, reading, 12, _MUTED)
    for index, row in enumerate(rows):
        top = TOP + ROW * index
        pen.box(14, top, WIDTH - 28, 1, _RULE)
        pen.text(_STRIP_X, top + 12, row.name, 14, _INK, bold=True)
        pen.text(_STRIP_X, top + 32, row.says, 12, _MUTED)
        pen.text(WIDTH - 16, top + 12, row.value, 14, _INK, bold=True, at="rt")


def _cell(pen: _Pen, flown: Flown, slot: int, place: int, top: float) -> None:
    """One slot in a row's strip."""
    x, y = _STRIP_X + _CELL * (place % _ACROSS), top + _STRIP_Y + _LINE * (place // _ACROSS)
    wide, high = _CELL - 2, _LINE - 3
    senders = flown.senders[slot] if slot < len(flown.senders) else ()
    colours = [agent_colour(agent) if flown.moving[agent - 1] else HOVER for agent in senders]
    if not senders:
        pen.box(x, y, wide, high, None, _RULE)
    for index, colour in enumerate(colours):
        pen.box(x + index * wide / len(colours), y, wide / len(colours), high, colour)
    if len(senders) > 1:
        pen.box(x - 1, y - 1, wide + 2, high + 2, None, _BAD)
        pen.box(x, y, wide, high, None, _BAD)
        pen.text(x + wide / 2, y + high / 2, "×", 15, "#ffffff", bold=True, at="mm", halo=_INK)
    elif senders:
        pen.text(x + wide / 2, y + high / 2, str(senders[0]), 9, ink_on(colours[0]), at="mm")


def _swarm(pen: _Pen, flown: Flown, slot: int, top: float) -> None:
    """The quadcopters from above, and who is sending."""
    extent = 1.2 * float(np.abs(flown.position[:, :2]).max())
    slot = min(slot, len(flown.position) - 1, len(flown.senders) - 1)
    place = (flown.position[: slot + 1, :2] * [[1], [-1]] / extent + 1) * _VIEW / 2 + [[14], [top + 7]]
    for k in np.flatnonzero(flown.moving):
        pen.line([(float(x), float(y)) for x, y in place[:: max(1, slot // 40), :, k]], agent_colour(k + 1), 1.3)
    senders = flown.senders[slot]
    for k in range(place.shape[2]):
        x, y = (float(value) for value in place[-1, :, k])
        colour = agent_colour(k + 1) if flown.moving[k] else HOVERING
        if k + 1 in senders:
            wave = _BAD if len(senders) > 1 else colour
            for radius, thick in ((9, 1.6), (13, 1.0)):
                pen.dot(x, y, radius, None, wave, thick)
        pen.dot(x, y, 5 if flown.moving[k] else 4, colour if flown.moving[k] or k + 1 in senders else HOVER, _PAPER)
