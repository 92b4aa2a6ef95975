"""The notebooks run from top to bottom, in plain Python, and are kept without what they printed."""

from __future__ import annotations

import ast
import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from bag_helpers import flight_bag
from matplotlib.figure import Figure

from dtsa import _plots

EXAMPLES = Path(__file__).resolve().parents[4] / "examples"
NOTEBOOKS = sorted(EXAMPLES.glob("*.ipynb"))

pytestmark = pytest.mark.skipif(not EXAMPLES.is_dir(), reason="the examples are part of the source tree only")


def run_cells(path: Path) -> tuple[dict[str, Any], list[Any]]:
    names: dict[str, Any] = {"__name__": "__main__"}
    shown: list[Any] = []
    for number, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
        if cell["cell_type"] != "code":
            continue
        tree = ast.parse("".join(cell["source"]), f"{path.name}, cell {number}")
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, f"{path.name}, cell {number}", "exec"), names)
        if last is not None:
            assert isinstance(last, ast.Expr)
            shown.append(eval(compile(ast.Expression(last.value), f"{path.name}, cell {number}", "eval"), names))
    return names, shown


def test_notebooks_show_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """IPython is told once how to show a figure, and nothing is taken from who told it before."""
    known: dict[type, Any] = {}
    formatter = SimpleNamespace(type_printers=known, for_type=known.__setitem__)
    shell = SimpleNamespace(display_formatter=SimpleNamespace(formatters={"image/png": formatter}))
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell, version_info=(9, 0)))
    _plots._show_in_notebooks()
    first = known[Figure]
    assert first(Figure()).startswith(b"\x89PNG")
    known[Figure] = "their own"
    _plots._show_in_notebooks()
    assert known[Figure] == "their own"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks_are_kept_without_outputs(path: Path) -> None:
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None


def test_the_notebook_of_the_library_runs(tmp_path, monkeypatch, capsys):
    flight_bag(tmp_path / "runs" / "b" / "bag", slots=60, loss=0.1, agents=6, policy="lease", seed=3)
    damaged = tmp_path / "runs" / "a" / "bag"
    shutil.copytree(tmp_path / "runs" / "b" / "bag", damaged)
    (file,) = damaged.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:5000])
    monkeypatch.chdir(tmp_path)
    names, shown = run_cells(EXAMPLES / "library.ipynb")
    assert sum(isinstance(each, Figure) for each in shown) == 7
    # What its text says.
    table = names["result"].table().set_index(["policy", "loss"])
    assert table.loc[("dtsa", 0.0), "age_mean_slots"] == table.xs(0.0, level="loss")["age_mean_slots"].min()
    error = table["estimate_error_mean_m"]
    assert error["dtsa", 0.2] > 5 * error["lease", 0.2]
    assert names["recording"].name == "b"
    assert str(damaged) in capsys.readouterr().out  # passed over, and named


def test_the_notebook_for_teachers_shows_what_it_claims(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    names, shown = run_cells(EXAMPLES / "teaching.ipynb")
    assert sum(isinstance(each, Figure) for each in shown) == 2
    paper = names["paper"].table().set_index(["scheme", "moving"])
    for moving in (2, 10, 18):
        hold, dtsa = paper.loc[("TDMA, hold", moving)], paper.loc[("DTSA, linear", moving)]
        assert dtsa["min_distance_m"] > hold["min_distance_m"]
        assert dtsa["efficiency_mean"] > hold["efficiency_mean"]
        assert dtsa["completion_time_s"] < hold["completion_time_s"]
    assert names["by_estimator"] > 0.03 > 10 * abs(names["by_policy"])
    assert names["ages"].loc[2, "dtsa"] < 1 < 8 < names["ages"].loc[2, "tdma"]
