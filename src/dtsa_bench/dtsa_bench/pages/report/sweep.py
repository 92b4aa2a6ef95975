"""The report of a sweep: one HTML file with figures and tables inside, that opens without a network."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path

from dtsa_bench.drawing.style import save, themed
from dtsa_bench.experiments.batch.table import write_whole
from dtsa_bench.experiments.figures.drawn import draw
from dtsa_bench.experiments.statistics import LEVEL, wilson
from dtsa_bench.experiments.sweep.aggregate import CRASHED, MEASURES, Group, Table, label_of
from dtsa_bench.experiments.sweep.claims import Claim, claims_of
from dtsa_bench.experiments.sweep.text import parts

_HERE = Path(__file__).resolve().parent


def write_report(table: Table, directory: Path, code: str, command: str = "") -> Path:
    """Draws all figures of a sweep and writes ``report.html``.

    :param table: the sweep's groups.
    :param directory: where; figures go to ``figures`` in it.
    :param code: fingerprint of the code that flew.
    :param command: how the sweep was started, shown so that it can be repeated.
    :returns: the report's path.
    """
    sweep = table.sweep
    drawn = []
    for spec in sweep.figures:
        figure = draw(table, spec)
        drawn.append((save(figure, directory / "figures", spec["name"]), str(spec.get("caption", "")).strip()))
    title = html.escape(sweep.title)
    sections = [
        f"<h1>{title}</h1>",
        f"<p class=lead>{html.escape(sweep.text)}</p>" if sweep.text else "",
        _facts(table, code, command),
        _claims(claims_of(table)),
        *(_figure(svg, text) for svg, text in drawn),
        "<h2>All settings</h2>",
        _groups(table),
        _left_out(table),
        _notes(len(table.sweep.seeds)),
    ]
    css = (_HERE / "assets" / "sweep.css").read_text(encoding="utf-8")
    page = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta name="color-scheme" content="light dark"><style>\n{css}</style></head>\n'
        f"<body><main>\n{chr(10).join(part for part in sections if part)}\n</main></body></html>\n"
    )
    path = directory / "report.html"
    write_whole(path, page)
    return path


def _figure(svg: str, text: str) -> str:
    """A picture in the page's colours, with its caption; too wide ones can be moved sideways."""
    caption = f"<figcaption>{html.escape(text)}</figcaption>" if text else ""
    return f"<figure><div class=wide tabindex=0>{themed(svg)}</div>{caption}</figure>"


def _facts(table: Table, code: str, command: str) -> str:
    seeds = table.sweep.seeds
    span = f"{seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else str(seeds[0])
    facts = [
        f"{table.runs} of {len(table.sweep.cells) * len(seeds)} flights",
        f"{len(table.sweep.cells)} settings",
        f"{len(seeds)} seeds ({span})",
        f"code {code}",
    ]
    line = " · ".join(html.escape(fact) for fact in facts)
    shown = f"<pre class=command>{html.escape(command)}</pre>" if command else ""
    return f"<p class=facts>{line}</p>{shown}"


def _claims(claims: Sequence[Claim]) -> str:
    if not claims:
        return ""
    rows = []
    for claim in claims:
        mark = {"holds": "yes", "does not hold": "no", "not decided": "open", "in part": "open"}.get(claim.verdict, "")
        badge = f'<span class="badge {mark}">{claim.verdict}</span>' if claim.verdict else ""
        rows.append(
            f'<tr><td data-name="The paper says">{html.escape(claim.paper) or "<i>beside it</i>"}</td>'
            f'<td data-name="We measured">{html.escape(claim.measured)}</td>'
            f'<td data-name="Holds?">{badge}</td><td data-name="Why">{html.escape(claim.why)}</td></tr>'
        )
    head = "<tr><th>The paper says</th><th>We measured</th><th>Holds?</th><th>Why</th></tr>"
    table = f"<table class=claims>{head}{''.join(rows)}</table>"
    return f"<h2>The paper, and what we measured</h2><div class=wide>{table}</div>"


def _groups(table: Table) -> str:
    measures = [name for name in MEASURES if any(group.mean(name).count for group in table.groups)]
    head = "".join(f"<th>{html.escape(axis)}</th>" for axis in table.sweep.axes)
    head += "<th>crashed</th><th>timed out</th><th>failed</th>"
    head += "".join(f"<th>{html.escape(label_of(name))}</th>" for name in measures) + "<th>counted</th>"
    rows = []
    for group in table.groups:
        if not group.rows:
            continue
        cells = [f"<td class=label>{html.escape(str(group.labels[axis]))}</td>" for axis in table.sweep.axes]
        cells.append(f"<td class={'bad' if group.crashed.count else 'good'}>{_small(parts(group, CRASHED))}</td>")
        cells += [f"<td>{group.timed_out or ''}</td>", f"<td>{group.failed or ''}</td>"]
        cells += [f"<td>{_small(parts(group, name))}</td>" for name in measures]
        cells.append(f"<td>{_counted(group)}</td>")
        rows.append(f"<tr>{''.join(cells)}</tr>")
    content = f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f'<div class="wide tall" tabindex=0><table class=groups>{content}</table></div>'


def _counted(group: Group) -> str:
    return f"{group.mean('min_distance_m').count}/{len(group.rows)}"


def _small(shown: tuple[str, str]) -> str:
    """A value, with its interval in small print."""
    value, interval = shown
    return f"{value} <small>{interval}</small>" if interval else value


def _left_out(table: Table) -> str:
    reasons = table.left_out()
    if not reasons:
        return "<p>No flight was left out: all were completed without a crash.</p>"
    items = "".join(f"<li>{count} {html.escape(reason)}</li>" for reason, count in sorted(reasons.items()))
    text = f"Left out of distances, efficiencies and times (as in the paper), of {table.runs} flights:"
    return f"<p>{text}</p><ul>{items}</ul>"


def _notes(seeds: int) -> str:
    return _NOTES.format(level=100 * LEVEL, seeds=seeds, most=100 * wilson(0, seeds).high)


_NOTES = """<h2>How to read this</h2><ul>
<li>Small print is a {level:.0f} % interval: Wilson's for crashes, a bootstrap over seeds for means.
0 of {seeds} still leaves up to {most:.0f} %.</li>
<li>Distances, efficiencies and times are those of completed flights without a crash; “counted” says how many
those are. Ages and errors are those of all flights.</li>
<li>Equal seeds mean equal scenarios, so differences between schemes are taken seed by seed.</li>
<li>A scheduler is to blame or to praise only where the estimator is the same, and where the oracle,
which knows everything, does not crash.</li></ul>"""
