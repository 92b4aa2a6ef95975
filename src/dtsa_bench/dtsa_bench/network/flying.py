"""One agent on a network: it flies, or only checks who is heard.

What is needed before or after a flight alone is imported there: many agents on one computer share little memory.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass

from dtsa_agent.air.driver import LiveAgent
from dtsa_agent.air.port import PortSettings
from dtsa_agent.air.ports import open_port
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import SwarmConfig
from dtsa_agent.stop import Stop


@dataclass(frozen=True, slots=True)
class AgentJob:
    """What one agent is to do."""

    own: AgentSettings
    config: SwarmConfig
    port: PortSettings
    out: str | None  # directory for its bag and summary; None: there are none
    as_json: bool  # print the result as JSON


def check(job: AgentJob, seconds: float) -> int:
    """Flies with the vehicle held, and prints who is heard, and by whom.

    :param seconds: how long; 0: as long as it takes.
    :raises ConfigError: for a port or an id that cannot be used.
    """
    from .check import Check, HeldVehicle, lasts_s, table

    duration = seconds or lasts_s(job.config)
    own = dataclasses.replace(job.own, duration_s=duration, quorum="0")  # it hovers anyway
    say = _speaker(own.id)
    say(f"checks for {duration:.0f} s who is heard; its vehicle is held")
    watcher = Check(own.id, job.config, job.port.properties)
    with Stop() as stop, open_port(job.port) as port:
        LiveAgent(own, job.config, port, watcher, HeldVehicle(), say=say).run(stop)
    result = watcher.result()
    print(json.dumps(result, indent=2) + "\n" if job.as_json else table(result), end="")
    if result["missing"]:
        say(f"not all hear all in time: {'; '.join(result['missing'])}")
    return int(bool(result["missing"]))


def fly(job: AgentJob) -> int:
    """Flies until a signal comes, and prints what came of it.

    :raises ConfigError: for a port, a directory or an id that cannot be used.
    :raises BagError: if the record is not whole.
    """
    failure = ""
    say = _speaker(job.own.id)
    with Stop() as stop, open_port(job.port) as port:
        agent = LiveAgent(job.own, job.config, port, say=say)
        if job.out is None:
            agent.run(stop)
            summary = agent.summary()
        else:
            from dtsa_bench.recordings.merge.agent_recorder import recorded

            with recorded(job.out, agent, job.port) as recorder:
                agent.run(stop)
            summary, failure = recorder.summary, recorder.failure
    from dtsa_bench.runs.hearing import of_datagrams
    from dtsa_bench.runs.summary_text import describe

    print(json.dumps(summary, indent=2) + "\n" if job.as_json else describe(summary), end="")
    not_taken_in = summary["not_taken_in"]
    # Two: this agent, and all others.
    hearing = of_datagrams(2, summary["slots"], summary["sent"], summary["heard"], not_taken_in)
    problem = hearing.problem(not_taken_in) if hearing.delivered else ""  # who is alone hears nobody
    problem = problem or summary["never_flew"]
    if problem:
        say(problem)
    if failure:
        from dtsa_bench.recordings.bag.errors import BagError

        raise BagError(failure)
    return int(bool(problem))


def _speaker(agent: int) -> Callable[[str], None]:
    """Prints a line about an agent on standard error."""

    def say(line: str) -> None:
        print(f"dtsa: cf{agent}: {line}", file=sys.stderr, flush=True)

    return say
