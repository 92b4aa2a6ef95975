"""What the documentation quotes of measurements, made from their records.

A quotation stands between ``<!-- evidence: NAME -->`` and ``<!-- end -->``; NAME is one of :data:`QUOTED`, and its
record ``docs/evidence/NAME.json``; ``records`` is the list of all records. A league's records are the entries in the
directory ``docs/evidence/NAME``. The command
``python -m dtsa_dev.documents.evidence_tables docs/*/*.md`` rewrites all quotations of these files.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.experiments.batch.table import markdown
from dtsa_bench.experiments.league.cells import league
from dtsa_bench.experiments.league.entry import read_entry
from dtsa_bench.experiments.league.table import HEADS, LeagueTable
from dtsa_bench.experiments.statistics import wilson

Row = dict[str, Any]

_BLOCK = re.compile(r"(<!-- evidence: (?P<name>[^>]*?) -->\n).*?(<!-- end -->)", re.DOTALL)
LIST = "records"  # what a page asks for that lists them all
LEAGUES = ("league-1",)
_SIZES = (18, 70, 200)
_PARTS = ("kernels", "avoidance", "slots", "flights", "nodes")  # of a benchmark, that are quoted


def rewritten(text: str, evidence: Path) -> str:
    """A page with its quotations made again; one without a record stays as it is.

    :param text: the page, Markdown.
    :param evidence: the directory of records.
    :raises ConfigError: if a quotation has a name that is neither :data:`LIST` nor one of :data:`QUOTED`.
    """

    def quotation(found: re.Match[str]) -> str:
        name = found["name"]
        if name == LIST:
            return f"{found[1]}{records(evidence)}{found[3]}"
        if name in LEAGUES:
            return f"{found[1]}{standings(evidence / name)}{found[3]}" if (evidence / name).is_dir() else found[0]
        if name not in QUOTED:
            raise ConfigError("evidence", name, ", ".join((*QUOTED, *LEAGUES, LIST)))
        record = evidence / f"{name}.json"
        if not record.exists():
            return found[0]
        return f"{found[1]}{QUOTED[name](json.loads(record.read_text(encoding='utf-8')))}{found[3]}"

    return _BLOCK.sub(quotation, text)


def records(evidence: Path) -> str:
    """The list of all records: what each looked at, with which command, when, on what.

    :param evidence: the directory of records.
    """
    lines = []
    for path in sorted(evidence.glob("*.json")):
        record = json.loads(path.read_text(encoding="utf-8"))
        low, high = record.get("load_of_items", [record.get("machine", {}).get("load", 0)] * 2)
        failed = len(record.get("failures", ()))
        lines.append(
            [
                f"[{path.stem}](../evidence/{path.name})",
                f"`tools/dtsa {_command(record)}`",
                record.get("promise", "Targets of speed.").rstrip(".") + ".",
                f"{record['finished']} of {record['items']}{f', {failed} failed' * bool(failed)}"
                if "items" in record
                else "",
                record["date"][:10],
                f"`{record['commit'][:9]}`{' and changes' if record['tree_changed'] else ''}",
                f"{record['cores']} cores, Python {record['python']}, load {low:.1f} to {high:.1f}",
            ]
        )
    heads = ("record", "command", "what should hold", "items done", "date", "commit", "machine")
    return f"{markdown(heads, lines)}\n"


def _command(record: Row) -> str:
    if "command" in record:
        return str(record["command"])
    if "soak" in record:
        return f"soak {record['soak']}"
    return f"benchmark --parts {','.join(record['parts'])}" if "parts" in record else "benchmark"


def speed(record: Row) -> str:
    """The table of speeds.

    :param record: ``benchmark.json`` of `dtsa benchmark`.
    :raises ConfigError: if a part is missing that the table quotes.
    """
    for part in _PARTS:
        if part not in record:
            raise ConfigError("parts", [name for name in _PARTS if name in record], ", ".join(_PARTS))
    machine = record["machine"]
    kernels = _by_size(record["kernels"], "priorities of all")
    avoided = _by_size(record["avoidance"], "avoidance of all")
    tdma, dtsa = (_by_size(record["slots"], "whole slot", policy) for policy in ("tdma", "dtsa"))
    flights = [_by_size(_plain(record["flights"]), "flight", policy) for policy in ("tdma", "dtsa")]
    lines = [
        ["all priorities g, one thread", *_cells(kernels, lambda row: _us(row["ours_us"]))],
        ["whole slot, tdma (policy, estimates, avoider, physics)", *_cells(tdma, lambda row: _us(row["core_us"]))],
        ["whole slot, dtsa", *_cells(dtsa, lambda row: _us(row["core_us"]))],
        ["pyrvo's avoidance step alone, ten neighbours", *_cells(avoided, lambda row: _us(row["pyrvo_ten_us"]))],
        ["whole slot over that step, tdma", *_cells(tdma, lambda row: f"{row['share_of_pyrvo']:.2f}")],
        ["whole slot over that step, dtsa", *_cells(dtsa, lambda row: f"{row['share_of_pyrvo']:.2f}")],
        *(
            [f"whole flight, {policy}", *_cells(rows, lambda row: f"{_figure(row['best_ms'])} ms")]
            for policy, rows in zip(("tdma", "dtsa"), flights, strict=True)
        ),
    ]
    heads = ("what", f"{_SIZES[0]} agents", *map(str, _SIZES[1:]))
    return (
        f"On {machine['cores']} cores of a server processor, load {machine['load']:.1f} before it began, Python "
        f"{machine['python']} ([its record](../evidence/speed.json), {record['date'][:10]}):\n\n"
        f"{markdown(heads, lines)}\n\n{_nodes(record['nodes'])}\n{_targets(record['targets'])}"
    )


def environments(record: Row) -> str:
    """How fast environments for learning are.

    :param record: ``benchmark.json`` of `dtsa benchmark --parts environments`.
    """
    lines = [
        [
            row["form"],
            str(row["flights"]),
            f"{row['loss']:g}",
            f"{row['agent_steps_per_s']:,.0f}",
            f"{row['limit_per_s']:,}",
            _us(row["slot_us"]),
            f"{row['over_simulate']:.1f}",
        ]
        for row in record["environments"]
    ]
    heads = (
        "form", "flights", "loss", "agent-steps/s", "target", "a slot of a flight", "over that of `simulate`",
    )  # fmt: skip
    machine, agents = record["machine"], record["environments"][0]["agents"]
    return (
        f"{agents} agents, TDMA by actions, one core of {machine['cores']}, load {machine['load']:.1f} before it began "
        f"([its record](../evidence/environments.json), {record['date'][:10]}):"
        f"\n\n{markdown(heads, lines)}\n\n{_targets(record['targets'])}"
    )


def fuzz(record: Row) -> str:
    """What fuzzing found.

    :param record: of `dtsa soak fuzz`.
    """
    found, failures = record["figures"], len(record["failures"])
    return (
        f"{record['wall_s'] / 60:.0f} minutes of it ([its record](../evidence/fuzz.json)): "
        f"{found['frames: inputs']:,} inputs of decoders and {found['agents: inputs']:,} streams of events, "
        f"{failures or 'no'} findings.\n"
    )


def board_cost(record: Row) -> str:
    """What a slot costs the app on board.

    :param record: of `dtsa embedded --board`.
    """
    cycles, clock = record["cycles_an_instruction"], record["clock_mhz"]

    def us(instructions: int) -> str:
        return f"{instructions * cycles / clock:,.0f}"

    lines = []
    for cost in record["costs"]:
        count = cost["instructions"]
        mean, most = count["slot"]
        lines.append(
            [
                cost["policy"], str(cost["agents"]),
                *(f"{count[kind][0]:,} / {count[kind][1]:,}" for kind in ("hear", "decide", "send", "steer", "slot")),
                f"{us(mean)} / {us(most)} us", f"{most * cycles / clock / record['slot_ms'] / 10:.0f} %",
                f"{cost['stack']:,} B", f"{cost['datagram']} B", f"{100 * cost['frames_of_air']:.1f} %",
                f"{100 * cost['polls_of_air']:.1f} %",
            ]
        )  # fmt: skip
    heads = (
        "policy", "N", "hear, mean / most", "decide", "send", "steer", "a slot", f"at {clock:g} MHz", "most, of a slot",
        "stack", "datagram", "frames, of the air", "polls",
    )  # fmt: skip
    sizes = record["memory"]
    return (
        f"{markdown(heads, lines)}\n\nCode and constants {sizes['code']:,} B, RAM {sizes['ram']:,} B, beside the stack "
        f"of {record['stack_of_task']:,} B ([its record](../evidence/board-cost.json)).\n"
    )


def mutants(record: Row) -> str:
    """How many small changes of the source the tests found.

    :param record: of `dtsa soak mutants`.
    """
    modules = {name: row for name, row in record["figures"].items() if name != "survivors"}
    lost = [failure["item"].rsplit(" ", 1)[0] for failure in record["failures"]]
    lines = [
        [name, *(str(n) for n in (row["found"], row["equivalent"], lost.count(name)))] for name, row in modules.items()
    ]
    found, equivalent = (sum(row[key] for row in modules.values()) for key in ("found", "equivalent"))
    led_to = sum("test" in row for row in record["figures"]["survivors"])
    return (
        f"{found} of {found + equivalent + len(lost)} are found ([its record](../evidence/mutants.json)), {led_to} of "
        f"them by tests to which earlier runs of the soak had led; of {equivalent} nobody can tell the difference, "
        f"{len(lost)} were not found.\n\n{markdown(('module', 'found', 'nobody can tell', 'not found'), lines)}\n"
    )


def flown_again(record: Row) -> str:
    """How many flights of entries were flown a second time.

    :param record: of `dtsa soak league`.
    """
    figures, failures = record["figures"], record["failures"]
    failed = f"; {len(failures)} entries failed: {', '.join(row['item'] for row in failures)}" if failures else ""
    return (
        f"All {figures['flights']:,} flights of {figures['entries']} entries were flown a second time, and had the "
        f"same rows and digests. {figures['forged']} entries with one number of one row changed, sums and "
        f"digest made anew, were found ([its record](../evidence/league.json)){failed}.\n"
    )


def serial(record: Row) -> str:
    """What came of flights over simulated modems.

    :param record: as ``soak serial`` writes it.
    """
    head = (
        "flight", "frames sent, not sent", "slots with two senders", "decisions made again, all equal",
        "slots apart: mean / largest", "mean age, in the simulator", "closest pair",
    )  # fmt: skip
    rows = [
        (
            name,
            f"{found['frames'][0]}, {found['frames'][1]}",
            f"{found['slots_with_two_senders']} of {found['slots']['total']}",
            f"{found['decisions_again']:,}",
            f"{found['clock_spread_ms']['mean']:.1f} / {found['clock_spread_ms']['max']:.1f} ms",
            "{:.2f}, {:.2f} slots".format(*found["age_mean_slots"]),
            f"{found['min_distance_m'][0]:.2f} m",
        )
        for name, found in record["figures"].items()
    ]
    low, high = record["load_of_items"]
    done = f"{record['finished'] - len(record['failures'])} of {record['items']} flights as they should be"
    return f"{markdown(head, rows)}\n\n{done}, in {record['wall_s'] / 60:.0f} minutes, load {low:.0f} to {high:.0f}.\n"


def standings(directory: Path) -> str:
    """The tables of a league: all scores, ages by cell, and who flew what.

    :param directory: of its entries.
    """
    entries = [read_entry(path) for path in sorted(directory.glob("*.json"))]
    table = LeagueTable(league(entries[0]["league"]), entries)
    cells = [[cell.name, cell.text] for cell in table.league.cells]
    flown = [
        [
            f"[{entry['name']}](league-1/{entry['name']}.json)",
            ", ".join(f"`{key}: {value}`" for key, value in entry["scheme"].items()),
            " ".join(str(entry["package"][key] or "") for key in ("distribution", "version")),
            str(entry["package"]["license"] or "not given"),
            str(entry["package"]["author"] or "not given"),
            f"`{entry['made_with']['commit'][:9]}`, {entry['made_with']['date'][:10]}",
        ]
        for entry in table.entries
    ]
    flights = sum(entry["summary"]["flights"] for entry in entries)
    return "\n\n".join(
        [
            f"{len(entries)} entries, {flights:,} flights, {entries[0]['seeds']} seeds. 95 % intervals in brackets.",
            markdown(HEADS, table.lines()),
            "Age in each cell, ms; in brackets the lost flights, if any:",
            markdown(("scheme", *table.cells), table.cell_lines()),
            markdown(("cell", "what it is"), cells),
            markdown(("entry", "sets", "package", "licence", "author", "flown by"), flown) + "\n",
        ]
    )


def board(record: Row) -> str:
    """What came of the protocol on board with faults.

    :param record: as ``soak board`` writes it.
    """
    head = (
        "fault", "flown", "fell", "closest pair", "frames heard", "mean age", "time hovered", "slots with two senders",
        "decisions made again, all equal",
    )  # fmt: skip
    rows = [
        (
            name,
            f"{found['seconds']:.0f} s",
            str(found["crashed"]),
            f"{found['min_distance_m']:.2f} m",
            f"{100 * found['heard_share']:.0f} %",
            f"{found['mean_age_ms']:.0f} ms",
            f"{100 * found['hover_share']:.1f} %",
            str(found["slots_with_two_senders"]),
            f"{found['decisions_again']:,}",
        )
        for name, found in record["figures"].items()
    ]
    return f"{markdown(head, rows)}\n"


def ns3(record: Row) -> str:
    """Who received what on the simulated channel and in ns-3.

    :param record: of `dtsa soak ns3`.
    """
    figures = record["figures"]
    same = (
        "scheme", "load", "frames", "receptions here, in ns-3", "pairs that differ", "arrivals apart by",
        "throughput here, in ns-3", "formula", "mean age here, in ns-3",
    )  # fmt: skip
    rows = [
        [
            row["scheme"],
            f"{row['load']:g}",
            f"{row['frames']:,}",
            "{:,}, {:,}".format(*row["received"]),
            f"{row['differ']} of {row['pairs']:,}",
            f"{row['arrivals_apart_ns']} ns",
            "{:.4f}, {:.4f} ± {:.4f}".format(row["throughput"][0][0], *row["throughput"][1]),
            f"{row['formula']:.4f}" if "formula" in row else "",
            "{:.1f}, {:.1f} ms".format(*row["age_ms"]),
        ]
        for row in figures["carried"]
    ]
    own = ("scheme", "load", "side", "sent", "given up", "received", "throughput", "formula", "mean wait", "95 % wait")
    cells: dict[tuple[str, float], list[Row]] = {}
    for row in figures["contended"]:
        cells.setdefault((row["scheme"], row["load"]), []).append(row)
    others = [
        [scheme, f"{load:g}", side, *_contended([run[key] for run in runs])]
        for (scheme, load), runs in cells.items()
        for side, key in (("here", "ours"), ("ns-3", "theirs"))
    ]
    failed = len(record["failures"])
    done = f"{record['finished'] - failed} of {record['items']} comparisons as they should be"
    parts = (
        f"ns-3 {' and '.join(figures['ns3'])}, {done} ([its record](../evidence/ns3.json)).",
        "The same instants on both channels:",
        markdown(same, rows),
        "Each side contends for itself. Means of its runs, smallest to largest; share received with its 95 % interval:",
        markdown(own, others),
    )
    return "\n\n".join(parts) + "\n"


def _contended(runs: Sequence[Row]) -> list[str]:
    sent, received, given_up = (sum(run[key] for run in runs) for key in ("sent", "received", "given_up"))
    share = wilson(received, sent)
    return [
        f"{sent:,}",
        f"{given_up:,}",
        f"{100 * received / sent:.1f} % ({100 * share.low:.1f} to {100 * share.high:.1f})",
        _mean([run["throughput"] for run in runs], 3),
        _mean([run["formula"] for run in runs], 3) if "formula" in runs[0] else "",
        f"{_mean([run['wait_ms']['mean'] for run in runs], 2)} ms",
        f"{_mean([run['wait_ms']['p95'] for run in runs], 1)} ms",
    ]


def _mean(values: Sequence[float], digits: int) -> str:
    mean = sum(values) / len(values)
    return f"{mean:.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def _plain(rows: Iterable[Row]) -> Iterable[Row]:
    return [row for row in rows if "avoider" not in row and "loss" not in row]


def _by_size(rows: Iterable[Row], what: str, policy: str | None = None) -> dict[int, Row]:
    return {row["agents"]: row for row in rows if row["what"] == what and row.get("policy") == policy}


def _cells(rows: dict[int, Row], text: Callable[[Row], str]) -> list[str]:
    return [text(rows[size]) if size in rows else "" for size in _SIZES]


def _figure(value: float) -> str:
    return f"{value:.1f}" if value < 10 else f"{value:.0f}"


def _us(value: float) -> str:
    return f"{_figure(value)} µs"


def _nodes(rows: Iterable[Row]) -> str:
    lines = []
    for row in rows:
        bare = f"{row['bare_rounds_per_s']:.0f}" if "bare_rounds_per_s" in row else ""
        limit = f"{row['limit_per_s']:.0f}" if row["limit_per_s"] else ""
        lines.append([str(row["agents"]), str(row["processes"]), f"{row['slots_per_s']:.0f}", limit, bare])
    heads = ("agents", "processes", "slots/s", "target", "rounds/s of bare messages")
    return f"Nodes in lockstep, recorded:\n\n{markdown(heads, lines)}\n"


def _targets(rows: Sequence[Row]) -> str:
    missed = [f"{row['target']}: {row['value']:.3g}, not {row['limit']:.3g}" for row in rows if not row["met"]]
    said = f"{len(rows) - len(missed)} of {len(rows)} targets are met"
    return f"{said}; not: {'; '.join(missed)}.\n" if missed else f"{said}.\n"


def twelve(record: Row) -> str:
    """The paper's experiment on board, beside the simulator and UDP.

    :param record: of `dtsa soak twelve`.
    """
    head = ("scheme", "lost", "age, slots: on board", "simulator", "UDP", "nearest pair, m: on board", "simulator",
            "UDP", "crashed: on board", "simulator", "UDP")  # fmt: skip
    forms = ("board", "simulator", "udp")
    rows = [
        (
            cell["scheme"],
            f"{cell['loss']:.0%}",
            *(f"{cell[form]['age_slots']:.2f}" if form in cell else "" for form in forms),
            *(f"{cell[form]['min_distance_m']:.2f}" if form in cell else "" for form in forms),
            *(cell[form]["crashed"] if form in cell else "" for form in forms),
        )
        for cell in record["figures"]["cells"]
    ]
    return f"{markdown(head, rows)}\n"


QUOTED: dict[str, Callable[[Row], str]] = {
    "board": board, "board-cost": board_cost,
    "speed": speed, "environments": environments, "fuzz": fuzz, "league": flown_again,
    "mutants": mutants, "serial": serial, "twelve": twelve, "ns3": ns3,
}  # fmt: skip


def main(paths: Sequence[str]) -> int:
    """Rewrites pages; records are in the directory ``evidence`` beside that of each."""
    for name in paths:
        path = Path(name)
        text = path.read_text(encoding="utf-8")
        path.write_text(rewritten(text, path.resolve().parent.parent / "evidence"), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
