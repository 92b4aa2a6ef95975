"""An agent in flight, without what only its command line needed.

`tools/dtsa agent` reads its options, finds out what takes more than an agent in flight has, and then this program takes
the place of that one: the same process with less memory. What it needs before or after a flight it imports there.
"""

from __future__ import annotations

import json
import os
import pickle
import sys
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from dtsa_agent.air.udp import AgentSettings, UdpAgent, UdpSettings
    from dtsa_agent.air.udp.prepared import Prepared
    from dtsa_agent.core import SwarmConfig
    from dtsa_agent.stop import Stop

_MODULE = "dtsa_bench.air.flying"


@dataclass(frozen=True, slots=True)
class Order:
    """A flight of one agent."""

    own: AgentSettings
    config: SwarmConfig
    udp: UdpSettings
    prepared: Prepared
    out: str | None  # directory for its bag and summary; None: there are none
    as_json: bool  # print the summary as JSON


def become(order: Order) -> None:
    """This process becomes one that only flies; returns where that is not possible.

    :param order: what it flies.
    """
    with suppress(OSError):
        given = os.memfd_create("order", 0)  # it is inherited
        with os.fdopen(os.dup(given), "wb") as file:
            pickle.dump(order, file)
        os.lseek(given, 0, os.SEEK_SET)
        sys.stdout.flush()
        sys.stderr.flush()
        paths = os.pathsep.join(path for path in sys.path if path)
        # -S: what is on the path is known, and to find it out again takes memory.
        words = [sys.executable, "-S", "-m", _MODULE, str(given), *sys.argv[1:]]
        os.execve(sys.executable, words, {**os.environ, "PYTHONPATH": paths})


def fly(order: Order) -> int:
    """Flies until a signal comes, and prints what came of it.

    :param order: what to fly.
    :returns: exit code.
    :raises ConfigError: for a network, a directory or an id that cannot be used.
    :raises BagError: if the record is not whole.
    """
    from dtsa_agent.air.udp import UdpAgent
    from dtsa_agent.stop import Stop

    failure, directory = "", None
    with Stop() as stop, UdpAgent(order.own, order.config, order.udp, prepared=order.prepared) as agent:
        if order.out is None:
            agent.run(stop)
        else:
            from dtsa_bench.options import new_directory

            directory = new_directory(order.out)
            failure = _run_recorded(agent, stop, directory)
    summary = agent.summary()
    text = json.dumps(summary, indent=2) + "\n"
    if directory is not None:
        (directory / "summary.json").write_text(text, encoding="utf-8")
    from dtsa_bench.summary_text import describe  # what is needed afterwards only takes no memory in flight

    print(text if order.as_json else describe(summary), end="")
    if failure:
        from dtsa_bench.bag.errors import BagError

        raise BagError(failure)
    return 0


def _run_recorded(agent: UdpAgent, stop: Stop, directory: Path) -> str:
    """Flies, and records it; why the record is not whole, or an empty text."""
    from dtsa_bench.air.recorder import AgentRecorder

    with AgentRecorder(directory / f"cf{agent.own.id}.mcap", agent.own, agent.config, agent.udp) as recorder:
        agent.watcher = recorder
        agent.run(stop)
        recorder.finish(agent.summary())
    return recorder.failure


def main() -> int:
    """The program of a process that has become an agent; its first word is the file descriptor of its order."""
    try:
        with os.fdopen(int(sys.argv[1]), "rb") as file:
            order = pickle.load(file)  # of this very process, before it became this one
        return fly(order)
    except KeyboardInterrupt:
        return 130
    except Exception as error:
        from dtsa_bench.cli import report

        return report(error)


if __name__ == "__main__":
    sys.exit(main())
