"""What a paper takes from a sweep: files that say how they were made, and numbers with their intervals."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pandas as pd
import pytest
from PIL import Image

import dtsa
from dtsa_bench.commands.cli import main
from dtsa_bench.experiments import provenance
from dtsa_bench.experiments.batch import run_all
from dtsa_bench.experiments.sweep import MEASURES, make_sweep
from dtsa_bench.experiments.tables import SHOWN, SweepTable, latex_text, table_html, table_text

AXES = {"loss": [0.0, 0.2], "scheme": {"a_b & 100 %": {"policy": "tdma"}, "lease <b>": {"policy": "lease"}}}
BASE = {"agents": 6, "timeout_s": 6.0}


@pytest.fixture(scope="module")
def swept() -> dtsa.SweepResult:
    return dtsa.sweep(axes=AXES, base=BASE, seeds=3)


@pytest.fixture(scope="module")
def table() -> SweepTable:
    plan = make_sweep({"axes": AXES, "base": BASE, "seeds": 3}, "small")
    return SweepTable(plan, run_all(plan.batch))


def test_each_file_says_how_it_was_made(swept: dtsa.SweepResult, tmp_path: Path) -> None:
    for form in ("pdf", "svg", "png"):
        files = swept.write_paper(tmp_path / form, form)
        assert [file.name for file in files] == [f"lines.{form}", "table.tex", "table.csv", "table.json"]
        assert {file.name for file in (tmp_path / form).iterdir()} == {file.name for file in files}
    made = json.loads((tmp_path / "pdf" / "table.json").read_text())
    assert made["command"] == swept.command
    assert made["seeds"] == [1001, 1002, 1003]
    assert made["settings"]["axes"]["loss"] == [0.0, 0.2]
    pdf = (tmp_path / "pdf" / "lines.pdf").read_bytes()
    with Image.open(tmp_path / "png" / "lines.png") as picture:
        described = str(picture.info["Description"])
    texts = {
        "pdf": pdf.decode("latin-1"),
        "svg": "".join(ElementTree.parse(tmp_path / "svg" / "lines.svg").getroot().itertext()),
        "png": described,
        "tex": (tmp_path / "pdf" / "table.tex").read_text(),
    }
    for form, text in texts.items():
        said = " ".join(text.replace("\\", "").split())
        for word in ("command: dtsa.sweep(axes={'loss': [0.0, 0.2]", f"commit: {made['commit']}", made["versions"]):
            assert word in said, form
        assert "seeds: 1001 to 1003" in said, form
        assert re.search(r"written: 20\d\d-\d\d-\d\dT\d\d:\d\dZ", said), form
    assert b"/Type0" in pdf  # TrueType, as publishers want
    assert b"/Type3" not in pdf


def test_the_call_that_is_kept_and_both_tables_are_the_sweep(swept: dtsa.SweepResult, tmp_path: Path) -> None:
    again = eval(swept.command, {"dtsa": dtsa})
    assert again.table().equals(swept.table())
    assert again.command == swept.command
    swept.write_paper(tmp_path)
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "table.csv"), swept.table(), check_dtype=False)
    text = (tmp_path / "table.tex").read_text()
    rows = [line for line in text.splitlines() if line.endswith(r"\\") and "shortstack" not in line]
    assert len(rows) == 4
    assert {len(re.findall(r"(?<!\\)&", row)) for row in rows} == {1 + 3}
    assert rows[0].startswith(r"0.0 & a\_b \& 100 \% & 0/3 {\footnotesize(0--56 \%)} & ")
    assert rows[1].startswith(r"0.0 & lease $<$b$>$ & ")
    assert text.count(r"\addlinespace") == 1
    assert latex_text("\\~^{x}#$|") == r"\textbackslash{}\textasciitilde{}\textasciicircum{}\{x\}\#\$$|$"


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no LaTeX here")
def test_latex_compiles_the_table(swept: dtsa.SweepResult, tmp_path: Path) -> None:
    swept.write_paper(tmp_path)
    document = r"\documentclass{article}\usepackage{booktabs}\begin{document}\small\noindent\input{table}\end{document}"
    (tmp_path / "paper.tex").write_text(document)
    done = subprocess.run(
        ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"],
        cwd=tmp_path, capture_output=True, text=True, errors="replace", timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:]
    assert "Overfull" not in done.stdout


def test_the_terminal_shows_every_interval_whatever_its_width(table: SweepTable) -> None:
    wide = table_text(table)
    assert len(wide.splitlines()) == 7  # with the legend
    for width in (80, 120):
        text = table_text(table, width)
        assert max(map(len, text.splitlines())) <= width
        assert sorted(set(text.split())) == sorted(set(wide.split()))
        assert text.count("lease <b>") == 2 * text.count("loss ")  # each part names its settings
        assert text.splitlines()[0].split()[2:8] == ["crashed", "95", "%", "out", "age", "slots"]
    for group in table.groups:
        assert f"{group.crashed.count}/3  " in wide
        mean = group.mean("age_mean_slots")
        assert f"{mean.value:.2f}  " in wide
        assert f"{mean.low:.2f}-{mean.high:.2f}" in wide
    assert "0-56 %" in wide
    narrow = table_text(table, 10)  # narrower than a label: one measure a part, nothing left out
    assert sorted(set(narrow.split())) == sorted(set(wide.split()))


def test_measures_that_no_flight_has_take_no_column_and_intervals_a_line(table, swept):
    plan = make_sweep({"axes": {"loss": [0.0]}, "base": {**BASE, "timeout_s": 0.3}, "seeds": 2}, "short")
    short = SweepTable(plan, run_all(plan.batch))
    assert "age slots" in table_text(short)
    assert "dist m" not in table_text(short)  # of completed flights alone
    assert set(SHOWN) <= set(MEASURES)
    page = ElementTree.fromstring(table_html(table))
    assert len(page.findall(".//tr")) == 5
    assert len(page.findall(".//svg")) == 4 * (1 + len(SHOWN))
    assert [cell.text for cell in page.findall(".//tr")[2].findall("td")[:2]] == ["0.0", "lease <b>"]
    assert "... 3 more settings" in table_html(table, most=1)
    assert "<b>" not in swept._repr_html_()


def test_the_command_writes_what_it_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["sweep", "--preset", "trajectories", "--set", "timeout_s=0.3", "--seeds", "1", "--jobs", "1"]
    assert main([*words, "--out", str(tmp_path / "a"), "--paper", "svg", "--no-report"]) == 0
    files = {path.name for path in (tmp_path / "a" / "paper").iterdir()}
    assert {"table.tex", "table.csv", "table.json", "trajectories.svg"} <= files
    assert f"paper: {tmp_path / 'a' / 'paper'}: " in capsys.readouterr().out
    assert main([*words, "--out", str(tmp_path / "b"), "--paper", "gif"]) == 2
    assert "error: paper: got 'gif'; allowed: pdf, svg, png" in capsys.readouterr().err
    assert not (tmp_path / "b").exists()


def test_sweeps_of_three_axes_without_numbers_have_tables_alone(tmp_path: Path) -> None:
    names = {"x": {"agents": 3}, "y": {"agents": 4}}
    axes = {"one": names, "two": {"c": {"loss": 0.1}}, "three": {"d": {}}}
    files = dtsa.sweep(axes=axes, base={"timeout_s": 0.2}, seeds=1).write_paper(tmp_path)
    assert [file.name for file in files] == ["table.tex", "table.csv", "table.json"]
    bars = dtsa.sweep(axes={"one": names}, base={"timeout_s": 0.2}, seeds=1).write_paper(tmp_path / "bars")
    assert bars[0].name == "bars.pdf"
    with pytest.raises(dtsa.ConfigError, match="out: got"):
        dtsa.sweep(axes={"one": names}, base={"timeout_s": 0.2}, seeds=1).write_paper(bars[0])


@pytest.mark.skipif(shutil.which("git") is None, reason="no git here")
def test_the_commit_of_somebody_elses_repository_is_not_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own.py").write_text("")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=x", "-c", "user.email=x@y"]
    for words in (["init", "-q"], ["add", "own.py"], ["commit", "-q", "-m", "own"]):
        subprocess.run([*git, *words], check=True)
    monkeypatch.setattr(provenance, "_HERE", tmp_path)
    assert provenance.read_provenance()["commit"] == "unknown"
