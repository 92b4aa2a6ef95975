"""`demo`: the same exchange of places three times: TDMA, TDMA with extrapolation, DTSA; recorded and compared."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dtsa_bench.batch.table import aligned
from dtsa_bench.options import new_directory, whole_number

INTERRUPTED = 130
VARIANTS = (("tdma", "hold"), ("tdma", "linear"), ("dtsa", "linear"))
_TABLE: tuple[tuple[str, str, str], ...] = (
    ("end", "end", "{}"),
    ("completion", "completion_time_s", "{:.2f} s"),
    ("closest", "min_distance_m", "{:.3f} m"),
    ("efficiency", "efficiency_mean", "{:.3f}"),
    ("mean age", "age_mean_slots", "{:.2f} slots"),
    ("oldest", "age_max_slots", "{} slots"),
    ("error of estimate", "estimate_error_mean_m", "{:.4f} m"),
    ("real-time factor", "realtime_factor", "{:.2f}"),
)


def add_parser(subparsers: Any) -> None:
    """Adds the command's parser."""
    parser = subparsers.add_parser(
        "demo",
        help="three flights of twelve quadcopters, recorded and compared, in a few minutes",
        description="Twelve quadcopters, each a ROS 2 node of its own, change places on a circle: with TDMA, where all "
        "others stand where they were last heard; with TDMA and extrapolation; with DTSA and extrapolation.",
    )
    parser.add_argument(
        "--out", metavar="DIR", default=None, help="new directory for everything [runs/demo-1, -2, ...]"
    )
    parser.add_argument("--agents", metavar="N", default="12", help="number of quadcopters [12]")
    parser.add_argument("--seed", metavar="N", default="1", help="seed of the flights [1]")
    parser.set_defaults(run=run)


def _directory(wanted: str | None) -> Path:
    if wanted is not None:
        return new_directory(wanted)
    number = 1
    while Path(f"runs/demo-{number}").exists():
        number += 1
    return new_directory(f"runs/demo-{number}")


def run(args: argparse.Namespace) -> int:
    """Flies, checks, compares.

    :returns: 0; 1 if a bag's check failed; 130 when interrupted.
    """
    from dtsa_agent.core import SwarmConfig
    from dtsa_bench.run_config import RunConfig

    agents = whole_number(args.agents, "agents", 2, 1024)
    seed = whole_number(args.seed, "seed", 0, 2**63 - 1)
    configs = [
        RunConfig(SwarmConfig(agents=agents, policy=policy, estimator=estimator, seed=seed))
        for policy, estimator in VARIANTS
    ]
    directory = _directory(args.out)

    from dtsa_agent.ros.common.loop import Stop
    from dtsa_bench.fly.flight import Flight, fly
    from dtsa_bench.trajectories import draw_flights

    begin = time.monotonic()
    print(
        f"{len(configs)} flights of {agents} quadcopters, {agents} ROS 2 nodes each, recorded to {directory}",
        flush=True,
    )
    flights: list[Flight] = []
    with Stop() as stop:
        for number, config in enumerate(configs, 1):
            swarm = config.swarm
            label = f"[{number}/{len(configs)}] {swarm.policy}, {swarm.estimator}"
            flights.append(fly(config, directory / f"{swarm.policy}-{swarm.estimator}", stop=stop, label=label))
            if stop:
                print(f"dtsa: the demo was interrupted; what was flown is in {directory}", file=sys.stderr)
                return INTERRUPTED
    picture = directory / "comparison.png"
    drawn = [(flight.scenario, flight.positions, flight.summary) for flight in flights]
    draw_flights(picture, drawn, f"{agents} quadcopters change places")
    print("\n" + table([flight.summary for flight in flights]) + "\n")
    checks = [_check(flight.bag) for flight in flights]
    _tell(directory, picture, flights)
    print(f"\n{time.monotonic() - begin:.0f} s in all")
    return 0 if all(checks) else 1


def table(summaries: Sequence[dict[str, Any]]) -> str:
    """The flights' results, a row a flight."""
    rows = [["", *(title for title, _, _ in _TABLE)]]
    for summary in summaries:
        cells = [f"{summary['policy'].upper()}, {summary['estimator']}"]
        cells += ["-" if summary[key] is None else form.format(summary[key]) for _, key, form in _TABLE]
        rows.append(cells)
    return aligned(rows, rule=True)


def _check(bag: Path) -> bool:
    """Verifies a bag and says in a line what was found."""
    from dtsa_bench.verify import verify_bag

    found = verify_bag(bag)
    if found.ok:
        crowded, alike = found.safety.get("slots_with_two_senders"), found.safety.get("all_agents_chose_alike")
        print(
            f"verified  {bag}: {sum(found.checked.values())} messages are what the protocol gives; "
            f"slots with two senders: {crowded}; all agents chose alike: {'yes' if alike else 'no'}"
        )
    else:
        print(f"NOT GOOD  {bag}: {found.difference}")
    return found.ok


def _tell(directory: Path, picture: Path, flights: Sequence[Any]) -> None:
    """Says where everything is and how to open it."""
    first = flights[0].bag
    print("\nWhere things are, and how to open them:")
    print(f"  {picture}: the three flights side by side (any image viewer)")
    for flight in flights:
        print(f"  {flight.bag.parent}: bag/ (the recording), trajectories.png, summary.json")
    print(f"  play a bag again:       tools/dtsa replay {first}   (or: ros2 bag play {first})")
    print(f"  look into a bag:        open {first / 'bag_0.mcap'} in Foxglove or PlotJuggler")
    print(f"  as tables:              tools/dtsa export {first}")
    print("  as a page:              tools/dtsa report " + " ".join(str(flight.bag) for flight in flights))
