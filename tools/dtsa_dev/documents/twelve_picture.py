"""The picture of the paper's experiment on board, from the record of `soak twelve`.

`python -m dtsa_dev.documents.twelve_picture docs/evidence/twelve.json docs/images/twelve.png` draws it.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from dtsa_bench import __version__
from dtsa_bench.drawing.style import colour, legend_above, panels, save_described, style

_PANELS = (("age_slots", "mean age, slots", True), ("min_distance_m", "minimum distance, m", False))
_FORMS = {"simulator": ("-", ""), "board": ("", "o"), "udp": ("", "x")}
_LABELS = {"simulator": "simulator", "board": "on board, laboratory", "udp": "over UDP"}


def picture(record: dict[str, Any]) -> Figure:
    """Ages and distances over losses: a line is the simulator, a disc the laboratory, a cross UDP.

    :param record: of `dtsa soak twelve`.
    """
    cells = record["figures"]["cells"]
    schemes = list(dict.fromkeys(cell["scheme"] for cell in cells))
    with style():
        figure, axes = panels(len(_PANELS), width=4.2, height=3.4)
        handles: dict[str, Any] = {}
        for axis, (name, title, logarithmic) in zip(axes, _PANELS, strict=True):
            for index, scheme in enumerate(schemes):
                for form, (line, marker) in _FORMS.items():
                    points = [(100 * c["loss"], c[form][name]) for c in cells if c["scheme"] == scheme and form in c]
                    if not points:
                        continue
                    look: dict[str, Any] = {
                        "linestyle": line or "none",
                        "marker": marker or None,
                        "color": colour(scheme, index),
                    }
                    drawn = axis.plot(*zip(*points, strict=True), markersize=6, **look)
                    if form == "simulator":
                        handles.setdefault(scheme, drawn[0])
            axis.set(xlabel="frames lost, %", ylabel=title, xticks=[0, 5, 10])
            if logarithmic:
                axis.set_yscale("log")
                axis.set_yticks([5, 6, 7, 10, 20, 50], labels=["5", "6", "7", "10", "20", "50"])
                axis.minorticks_off()
        for form, (line, marker) in _FORMS.items():
            (handles[_LABELS[form]],) = axes[0].plot(
                [], [], linestyle=line or "none", marker=marker or None, color="#5b6774"
            )
        legend_above(figure, list(handles.values()), list(handles))
    return figure


def main(record: str, picture_file: str) -> int:
    """Draws the record of a soak into a file.

    :param record: the record, JSON.
    :param picture_file: PDF, SVG or PNG.
    """
    found = json.loads(Path(record).read_text(encoding="utf-8"))
    save_described(
        picture(found), Path(picture_file), "The paper's experiment on board",
        f"tools/dtsa soak twelve, commit {found['commit']}, seeds {found['seeds']}", f"dtsa {__version__}",
    )  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
