"""An agent in flight, without what only its command line needed.

`tools/dtsa agent` reads its options, finds out what takes more than an agent in flight has, and then
`commands.agent_process` takes its place: the same process with less memory. What it needs before or after a flight it
imports there.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dtsa_agent.air.port import PortSettings
    from dtsa_agent.air.prepared import Prepared
    from dtsa_agent.air.settings import AgentSettings
    from dtsa_agent.core import SwarmConfig


@dataclass(frozen=True, slots=True)
class Order:
    """A flight of one agent."""

    own: AgentSettings
    config: SwarmConfig
    port: PortSettings
    prepared: Prepared
    out: str | None  # directory for its bag and summary; None: there are none
    as_json: bool  # print the summary as JSON


def become(order: Order, program: str) -> None:
    """This process becomes one that only flies; returns where that is not possible.

    :param order: what it flies.
    :param program: name of the module that it becomes; its first word is the file descriptor of the pickled order.
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
        words = [sys.executable, "-S", "-m", program, str(given), *sys.argv[1:]]
        os.execve(sys.executable, words, {**os.environ, "PYTHONPATH": paths})


def check(order: Order, seconds: float) -> int:
    """Flies with the vehicle held, and prints who is heard, and by whom.

    :param order: the agent; its bag is not made.
    :param seconds: how long; 0: as long as it takes.
    :returns: exit code: 0 if all hear all in time.
    :raises ConfigError: for a port or an id that cannot be used.
    """
    from dtsa_agent.air.agent import AirAgent
    from dtsa_agent.air.ports import open_port
    from dtsa_agent.stop import Stop

    from .check import Check, HeldVehicle, lasts_s, table

    duration = seconds or lasts_s(order.config)
    own = dataclasses.replace(order.own, duration_s=duration, quorum="0")  # it hovers anyway
    say = _speaker(own.id)
    say(f"checks for {duration:.0f} s who is heard; its vehicle is held")
    watcher = Check(own.id, order.config, order.port.properties)
    with Stop() as stop, open_port(order.port) as port:
        AirAgent(own, order.config, port, watcher, HeldVehicle(), order.prepared, say).run(stop)
    result = watcher.result()
    print(json.dumps(result, indent=2) + "\n" if order.as_json else table(result), end="")
    if result["missing"]:
        say(f"not all hear all in time: {'; '.join(result['missing'])}")
    return int(bool(result["missing"]))


def _speaker(agent: int) -> Callable[[str], None]:
    """Says a line in flight, on stderr."""

    def say(line: str) -> None:
        print(f"dtsa: cf{agent}: {line}", file=sys.stderr, flush=True)

    return say


def fly(order: Order) -> int:
    """Flies until a signal comes, and prints what came of it.

    :param order: what to fly.
    :returns: exit code.
    :raises ConfigError: for a port, a directory or an id that cannot be used.
    :raises BagError: if the record is not whole.
    """
    from dtsa_agent.air.agent import AirAgent
    from dtsa_agent.air.ports import open_port
    from dtsa_agent.stop import Stop

    failure = ""
    with Stop() as stop, open_port(order.port) as port:
        agent = AirAgent(order.own, order.config, port, prepared=order.prepared, say=_speaker(order.own.id))
        if order.out is None:
            agent.run(stop)
            summary = agent.summary()
        else:
            from dtsa_bench.recordings.merge.agent_recorder import recorded

            with recorded(order.out, agent, order.port) as recorder:
                agent.run(stop)
            summary, failure = recorder.summary, recorder.failure
    from dtsa_bench.runs.hearing import of_datagrams
    from dtsa_bench.runs.summary_text import describe  # what is needed afterwards only takes no memory in flight

    print(json.dumps(summary, indent=2) + "\n" if order.as_json else describe(summary), end="")
    not_taken_in = summary["not_taken_in"]
    hearing = of_datagrams(
        2, *(summary[key] for key in ("slots", "sent", "heard")), not_taken_in
    )  # this agent and the others
    problem = hearing.problem(not_taken_in) if hearing.delivered else ""  # who is alone hears nobody
    problem = problem or summary["never_flew"]
    if problem:
        print(f"dtsa: cf{summary['id']}: {problem}", file=sys.stderr)
    if failure:
        from dtsa_bench.recordings.bag.errors import BagError

        raise BagError(failure)
    return int(bool(problem))
