"""`dtsa losses`: who heard whom in recorded flights, and a channel that loses as much."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

DESCRIPTION = """\
Learns from recorded, merged or sniffed flights, or from tables (.csv), what each directed link lost: its rate, bursts
(the chain of Gilbert and Elliott by maximum likelihood, with intervals of 95 %), and how losses depend on distance
where places are known. --out writes a file that simulate, sweep and fly take as --losses; --csv writes a table, which
they replay slot by slot."""
_SHOWN = 8  # links that lose most


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the command."""
    parser = subparsers.add_parser(
        "losses", help="what each link lost, as a channel to fly in", description=DESCRIPTION
    )
    parser.add_argument(
        "runs", nargs="+", metavar="RUN",
        help="run directory, bag directory or .mcap file, also of merge or sniff; or a table (.csv)",
    )  # fmt: skip
    parser.add_argument("--out", metavar="FILE", help="write a file of losses, JSON")
    parser.add_argument("--csv", metavar="FILE", help="write who heard whom of a single RUN as a table")
    parser.add_argument("--slot-ms", metavar="X", help="length of a slot, of tables; needed for those with times")
    parser.add_argument("--json", action="store_true", help="print the file of losses instead of lines")


def run(args: argparse.Namespace) -> int:
    """Learn, and print what came of it."""
    from dtsa_agent.core.errors import ConfigError
    from dtsa_agent.core.settings.declaration import Setting
    from dtsa_bench.recordings.losses.learn import learn
    from dtsa_bench.recordings.losses.observed import observe
    from dtsa_channel_sim.model.loss_table import write_table

    slot_ns = 0
    if args.slot_ms is not None:
        setting = Setting("slot_ms", "float", None, "length of a slot", unit="ms", minimum=0.001, maximum=1e6)
        slot_ns = round(setting.read(args.slot_ms) * 1e6)
    if args.csv and len(args.runs) > 1:
        raise ConfigError("csv", args.csv, "a single RUN: a table holds one flight")
    for name in ("out", "csv"):
        path = getattr(args, name)
        if path and (Path(path).exists() or not Path(path).parent.is_dir()):
            raise ConfigError(name, path, "a new file in a directory that exists")
    if args.csv and not args.csv.lower().endswith(".csv"):
        raise ConfigError("csv", args.csv, "a file *.csv")
    flights = [observe(path, slot_ns) for path in args.runs]
    losses = learn(flights)
    text = json.dumps(losses, indent=1) + "\n"
    if args.out:
        try:
            Path(args.out).write_text(text, encoding="utf-8")
        except OSError as error:
            raise ConfigError("out", args.out, f"a file that can be written ({error.strerror})") from None
    if args.csv:
        rows = write_table(args.csv, flights[0].table)
        print(f"{args.csv}: {rows} rows", file=sys.stderr)
    print(text if args.json else "\n".join(lines(losses)) + "\n", end="")
    return 0


def lines(losses: dict[str, Any]) -> list[str]:
    """What was learnt, in a few lines."""
    whole = losses["all"]
    slots = f", slots of {losses['slot_ns'] / 1e6:g} ms" if losses["slot_ns"] else ""
    found = [f"{losses['agents']} agents, {whole['links']} links{slots}: {losses['frames']} frames, {whole['sent']} "
             f"receptions looked at, {_percent(whole['loss'])} lost ({_between(whole['loss_interval'])})"]  # fmt: skip
    if losses["left_out"]:
        parts = [f"{count} frames, {reason}" for reason, count in losses["left_out"].items()]
        found.append(f"left out: {'; '.join(parts)}")
    found.append(_bursts(losses))
    shown = sorted(losses["links"], key=lambda link: -link["loss"])[:_SHOWN]
    found.append("links that lose most:" if len(shown) < whole["links"] else "links:")
    found += [f"  {_link(link)}" for link in shown]
    distance = losses["distance"]
    if distance is not None:
        found.append("lost by distance:")
        found += [
            f"  {part['from_m']:7.2f} to {part['to_m']:7.2f} m  {_percent(part['loss'])} "
            f"({_between(part['loss_interval'])}) of {part['sent']}"
            for part in distance["bins"]
        ]
    return found


def _bursts(losses: dict[str, Any]) -> str:
    whole = losses["all"]
    what = "receivers" if losses["scope"] == "receiver" else "links"
    kinds = [one["chain"] for one in losses[what]]
    if whole["pooled"] is None and "own" not in kinds:
        return f"bursts: none found (p = {whole['p_value']:.2g}); losses are independent from slot to slot"
    pooled = whole["pooled"]
    memory = ""
    if pooled is not None:
        low, high = (1.0 / max(1e-9, 1.0 - value) for value in pooled["kept_interval"])
        memory = (f"; all {what} together: losses {_percent(pooled['loss_good'])} and {_percent(pooled['loss_bad'])}, "
                  f"memory {1.0 / (1.0 - pooled['kept']):.3g} slots ({low:.3g} to {high:.3g})")  # fmt: skip
    return f"bursts: {kinds.count('own')} {what} have chains of their own, {kinds.count('pooled')} a common one{memory}"


def _link(link: dict[str, Any]) -> str:
    receiver = f"cf{link['receiver']}" if link["receiver"] else "listener"
    rate = f"{_percent(link['loss'])} ({_between(link['loss_interval'])}) of {link['sent']}"
    text = f"cf{link['sender']} -> {receiver}: {rate}"
    if link["chain"] != "own":
        return text
    low, high = link["leave_interval"]
    ends = f"{1.0 / high:.3g} to {1.0 / low:.3g}" if low > 0 else f"{1.0 / high:.3g} or more"
    return (f"{text}; bad phases of {1.0 / link['leave']:.3g} slots ({ends}), losses {_percent(link['loss_good'])} and "
            f"{_percent(link['loss_bad'])}")  # fmt: skip


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %"


def _between(interval: list[float]) -> str:
    return f"{100.0 * interval[0]:.3g} to {100.0 * interval[1]:.3g}"
