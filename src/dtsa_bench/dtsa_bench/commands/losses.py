"""`dtsa losses`: what each link lost in recorded flights, as a channel to fly in."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

DESCRIPTION = """\
Learns from recorded or merged flights what each directed link lost: its rate, and a two-state chain where losses come
in bursts. --out writes a file that simulate, sweep and fly take as --losses."""
EXAMPLES = (("runs/a --out hall.json", "for simulate, sweep and fly, as --losses hall.json"),)
_SHOWN = 8  # links that lose most


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument(
        "runs", nargs="+", metavar="RUN", help="run directory, bag directory or .mcap file, also of merge"
    )
    parser.add_argument("--out", metavar="FILE", help="write a file of losses, JSON")
    parser.add_argument("--json", action="store_true", help="print the file of losses instead of lines")


def run(args: argparse.Namespace) -> int:
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
    print(text if args.json else "\n".join(lines(losses)) + "\n", end="")
    return 0


def lines(losses: dict[str, Any]) -> list[str]:
    """Return what was learnt, in a few lines."""
    agents = range(losses["agents"])
    links = [
        (losses["lost"][s][r] / sent, sent, s, r) for s in agents for r in agents if (sent := losses["sent"][s][r])
    ]
    found = [
        f"{len(agents)} agents, {len(links)} links, slots of {losses['slot_ns'] / 1e6:g} ms: {losses['frames']} frames,"
        f" {sum(link[1] for link in links)} receptions, {100.0 * losses['loss']:.3g} % lost"
    ]
    if losses["left_out"]:
        found.append("left out: " + "; ".join(f"{count} frames, {text}" for text, count in losses["left_out"].items()))
    memory = losses["memory_slots"]
    found.append(f"bursts: all links together have a memory of {memory:g} slots" if memory else "bursts: none found")
    found.append("links that lose most:")
    for loss, sent, sender, receiver in sorted(links, key=lambda link: -link[0])[:_SHOWN]:
        leave, bad = losses["leave"][sender][receiver], losses["loss_bad"][sender][receiver]
        phases = (
            f"; bad phases of {1.0 / leave:.3g} slots, {100.0 * bad:.3g} % lost in them" if 0.0 < leave < 1.0 else ""
        )
        found.append(f"  cf{sender + 1} -> cf{receiver + 1}: {100.0 * loss:.3g} % of {sent}{phases}")
    return found
