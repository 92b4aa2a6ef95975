"""Commands about recorded runs: verify, recover, export, report, merge, losses."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from .registry import RECORDED_RUN, Command, warn

TABLES = ("slots", "frames", "receptions", "decisions", "states", "ages", "ages_by_observer", "distances")
_SHOWN = 8  # links that lose most


class VerifyCommand(Command):
    description = """\
Rebuilds every agent and the channel from the recorded configuration, feeds them what they heard, and compares
every message of the bag, byte by byte. Exit code 0: all equal; 1: a difference, which is shown."""
    examples = (("runs/a", "one run"), ("runs/a runs/b --json", "several, as JSON"))
    options = (
        ("bag bag...", RECORDED_RUN),
        ("--json", "print the result as JSON"),
    )  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
        """Verify the bags."""
        from dtsa_bench.log.verify.check import verify_bag

        live = sys.stderr.isatty()

        def progress(slot: int) -> None:
            print(f"\rslot {slot}", end="", file=sys.stderr, flush=True)

        results = []
        for path in args.bag:
            results.append(verify_bag(path, progress if live else None))
            if live:
                print("\r\033[K", end="", file=sys.stderr)
            if not args.json:
                print(results[-1])
        if args.json:
            print(json.dumps([result.to_dict() for result in results], indent=2))
        return 0 if all(result.ok for result in results) else 1


class RecoverCommand(Command):
    description = """\
Makes a full bag of what a killed recorder, a full disk or a damaged file left: all that can be read. It says what was
saved, and what is lost. The original is only read."""
    examples = (("runs/a", "into runs/a/bag_recovered"),)
    options = (
        ("bag", RECORDED_RUN),
        ("--out DIR", "where to (default: <bag>_recovered beside the old one)"),
        ("--json", "print what was saved as JSON"),
    )  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
        """Recover the bag."""
        from dtsa_bench.log.bag.recover import recover

        result = recover(args.bag, args.out)
        if args.json:
            print(json.dumps(dataclasses.asdict(result), indent=2, default=str))
            return 0
        width = max(len(topic) for topic in result.saved)
        for topic, count in result.saved.items():
            expected = result.expected.get(topic, count)
            missing = f"  ({expected - count} missing)" if expected > count else ""
            print(f"{topic:{width}}  {count:>9}{missing}")
        seconds = (result.end_ns - result.start_ns) / 1e9
        print(f"saved {result.count} messages, {seconds:.3f} s of simulated time, to {result.directory}")
        if not result.closed:
            print(f"  the recording breaks off at {result.whole_ns / 1e9:.3f} s; `verify` checks it up to there")
        for note in result.damaged or ["the file was whole: nothing was lost"]:
            print(f"  {note}")
        return 0


class ExportCommand(Command):
    description = """\
Writes a recorded run as tables for pandas and polars: slots, frames, who received them, decisions, states, ages and
errors (of each agent; of each agent in the eyes of each observer), one file each, and columns.md, which says what each
column holds and in which unit."""
    examples = (
        ("runs/a", "all tables as Parquet"),
        ("runs/a --to csv --tables slots frames --out tables", "two of them as CSV"),
    )
    options = (
        ("bag", RECORDED_RUN),
        ("--to FORMAT", "parquet (default) or csv", {"default": "parquet"}),
        ("--out DIR", "where to (default: <bag>_tables beside the bag)"),
        ("--tables TABLE...", f"only these: {' '.join(TABLES)}"),
        ("--json", "print the files and their rows as JSON"),
    )  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
        """Export the bag."""
        import pyarrow  # noqa: F401  # if it is missing, that is said before a bag is read

        from dtsa_bench.log.bag.metadata import bag_of
        from dtsa_bench.log.merged_bag import open_log
        from dtsa_bench.log.tables import export

        bag = bag_of(args.bag).resolve()
        target = args.out or bag.with_name(f"{bag.name if bag.is_dir() else bag.stem}_tables")
        written = export(lambda: open_log(args.bag), target, args.to, args.tables, warn)
        if args.json:
            print(json.dumps([{"path": str(table.path), "rows": table.rows} for table in written], indent=2))
            return 0
        for table in written:
            print(f"{table.path}: {table.rows} rows")
        return 0


class ReportCommand(Command):
    description = """\
Writes one self-contained HTML page about one recorded run, or several side by side: the flight in 3D, the slots,
distances, ages, estimate errors, channel use, decisions and the configuration. It opens without a network, and
prints."""
    examples = (("runs/a", "one run"), ("runs/a runs/b --out compared.html", "two side by side"))
    options = (
        ("bags BAG...", f"{RECORDED_RUN}; up to 8"),
        ("--out FILE", "the page (default: report.html beside the first bag)"),
    )  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
        """Write the report."""
        from dtsa_bench.log.bag.metadata import bag_of
        from dtsa_bench.pages.report.data import write_report

        first = bag_of(args.bags[0]).resolve()
        out = Path(args.out) if args.out else first.parent / "report.html"

        def progress(bag: str) -> None:
            if sys.stderr.isatty():
                print(f"reading {bag}", file=sys.stderr, flush=True)

        path = write_report(args.bags, out, progress)
        print(f"{path} ({path.stat().st_size / 1e6:.1f} MB): open it in any browser")
        return 0


class MergeCommand(Command):
    description = """\
Joins the bags that agents on a network have made of their own flights on one time line, by the frames that they share,
and says what came of the flight: clocks, ages, errors, agreement, the closest pair; whether two sent in one turn;
whether all decisions follow from what each agent heard, made again by the core. Exit code 1 if they do not, if the
agents did not hear each other, or if frames do not go both ways between groups of them: offsets of clocks are not
determined then. --out keeps the whole flight as one bag, which report, export, verify, replay and ros2
bag take like any other."""
    examples = (
        ("runs/cf1 runs/cf2 runs/cf3", "three agents' bags"),
        ("runs/cf* --json", "all of them, as JSON"),
        ("runs/cf* --out flight_1", "kept as one bag, for report, export and verify"),
    )
    options = (
        ("bags BAG...", "directory of `agent --out`, or its .mcap file"),
        ("--out DIR", "keep the whole flight there: bag, and result as summary.json"),
        ("--json", "print the result as JSON instead of lines"),
    )  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
        """Merge, and print what came of it."""
        from dtsa_bench.log.agent_bag import read_all
        from dtsa_bench.log.merge.merge import Merge, clocks_apart, is_verified
        from dtsa_bench.runs.options import check_free

        if args.out:
            check_free(Path(args.out))
        merged = Merge(*read_all(args.bags))
        summary = merged.summary()
        if args.out:
            from dtsa_bench.log.merged_bag import write_merged

            write_merged(Path(args.out), merged.log, summary)
        text = json.dumps(summary, indent=2) + "\n"
        print(text if args.json else "\n".join(summary_lines(summary)) + "\n", end="")
        if summary["unheard"]:
            warn(summary["unheard"])
        if merged.apart:
            warn(clocks_apart(merged.apart))
        for path in merged.nothing_written:
            warn(f"{path}: nothing was written there; left out")
        return 0 if is_verified(summary) and not summary["unheard"] else 1


def summary_lines(summary: dict[str, object]) -> list[str]:
    """A summary, indented where it has parts."""
    rows = []
    for key, value in summary.items():
        name = key.replace("_", " ")
        if isinstance(value, dict):
            rows += [f"{name}:", *(f"  {line}" for line in summary_lines(value))]
        else:
            text = f"{value:.6g}" if isinstance(value, float) else "-" if value in (None, []) else value
            rows.append(f"{name:26} {text}")
    return rows


class LossesCommand(Command):
    description = """\
Learns from recorded or merged flights what each directed link lost: its rate, and a two-state chain where losses come
in bursts. --out writes a file that simulate, sweep and fly take as --losses."""
    examples = (("runs/a --out hall.json", "for simulate, sweep and fly, as --losses hall.json"),)
    options = (
        ("runs RUN...", "run directory, bag directory or .mcap file, also of merge"),
        ("--out FILE", "write a file of losses, JSON"),
        ("--json", "print the file of losses instead of lines"),
    )  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
        """Learn, and print what came of it."""
        from dtsa_agent.core.errors import ConfigError
        from dtsa_bench.log.losses import learn

        if args.out and (Path(args.out).exists() or not Path(args.out).parent.is_dir()):
            raise ConfigError("out", args.out, "a new file in a directory that exists")
        losses = learn(args.runs)
        text = json.dumps(losses) + "\n"
        if args.out:
            try:
                Path(args.out).write_text(text, encoding="utf-8")
            except OSError as error:
                raise ConfigError("out", args.out, f"a file that can be written ({error.strerror})") from None
        print(text if args.json else "\n".join(loss_lines(losses)) + "\n", end="")
        return 0


def loss_lines(losses: dict[str, Any]) -> list[str]:
    """Return what was learnt, in a few lines."""
    agents, memory = range(losses["agents"]), losses["memory_slots"]
    pairs = [(s, r, losses["sent"][s][r]) for s in agents for r in agents]
    links = [(losses["lost"][s][r] / sent, sent, s, r) for s, r, sent in pairs if sent]
    rows = [
        f"{len(agents)} agents, {len(links)} links, slots of {losses['slot_ns'] / 1e6:g} ms: {losses['frames']} frames,"
        f" {sum(link[1] for link in links)} receptions, {100.0 * losses['loss']:.3g} % lost"
    ]
    if losses["left_out"]:
        rows.append("left out: " + "; ".join(f"{count} frames, {text}" for text, count in losses["left_out"].items()))
    rows.append(f"bursts: all links together have a memory of {memory:g} slots" if memory else "bursts: none found")
    rows.append("links that lose most:")
    for loss, sent, s, r in sorted(links, key=lambda link: -link[0])[:_SHOWN]:
        leave, bad = losses["leave"][s][r], losses["loss_bad"][s][r]
        is_bursty = 0.0 < leave < 1.0
        phases = f"; bad phases of {1.0 / leave:.3g} slots, {100.0 * bad:.3g} % lost in them" if is_bursty else ""
        rows.append(f"  cf{s + 1} -> cf{r + 1}: {100.0 * loss:.3g} % of {sent}{phases}")
    return rows
