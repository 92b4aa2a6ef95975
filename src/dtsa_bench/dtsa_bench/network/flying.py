"""One agent on a network: it flies, or only checks who is heard.

What is needed before or after a flight alone is imported there: many agents on one computer share little memory.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dtsa_agent.air.driver import LiveAgent
from dtsa_agent.air.port import PortSettings, open_port
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
    """Fly with the vehicle held, for seconds (0: as long as it takes), and print who is heard, and by whom.

    :raises ConfigError: for a port or an id that cannot be used.
    """
    from .check import Check, HeldVehicle, lasts_s, table

    duration = seconds or lasts_s(job.config)
    own = dataclasses.replace(job.own, duration_s=duration, quorum="0")  # it hovers anyway
    log = _Terminal(own.id).log
    log(f"checks for {duration:.0f} s who is heard; its vehicle is held")
    watcher = Check(own.id, job.config, job.port.properties)
    with Stop() as stop, open_port(job.port) as port:
        LiveAgent(own, job.config, port, watcher, HeldVehicle(), log=log).run(stop)
    result = watcher.result()
    print(json.dumps(result, indent=2) + "\n" if job.as_json else table(result), end="")
    if result["missing"]:
        log(f"not all hear all in time: {'; '.join(result['missing'])}")
    return int(bool(result["missing"]))


def fly(job: AgentJob) -> int:
    """Flies until a signal comes, and prints what came of it.

    :raises ConfigError: for a port, a directory or an id that cannot be used.
    :raises BagError: if the record is not whole.
    """
    failure = ""
    terminal = _Terminal(job.own.id)
    show = terminal.show if sys.stderr.isatty() else None
    with Stop() as stop, open_port(job.port) as port:
        agent = LiveAgent(job.own, job.config, port, log=terminal.log, show=show)
        if job.out is None:
            agent.run(stop)
            summary = agent.summary()
        else:
            from dtsa_bench.log.agent_bag import recorded

            with recorded(job.out, agent, job.port) as recorder:
                agent.run(stop)
            summary, failure = recorder.summary, recorder.failure
    from dtsa_bench.runs.delivery import counts_of_datagrams

    terminal.clear()
    print(json.dumps(summary, indent=2) if job.as_json else brief(summary))
    not_taken_in = summary["not_taken_in"]
    # Two: this agent, and all others.
    hearing = counts_of_datagrams(2, summary["slots"], summary["sent"], summary["heard"], not_taken_in)
    heard_too_little = hearing.problem(not_taken_in) if hearing.delivered else ""  # who is alone hears nobody
    if problem := heard_too_little or summary["never_flew"]:
        terminal.log(problem)
    if failure:
        from dtsa_bench.log.bag.errors import BagError

        raise BagError(failure)
    return int(bool(problem))


def brief(summary: Mapping[str, Any]) -> str:
    """What came of an agent's flight, for people; ``--json`` and ``summary.json`` have all of it."""

    def reasons(counts: Mapping[str, int]) -> str:
        return ", ".join(f"{count} {reason}" for reason, count in counts.items())

    early, later = summary["held_at_start_slots"], summary["held_slots"]
    share, late = summary["heard_share"], summary["send_late_ms"]["p99"]
    rows = {
        "state": f"{summary['state']}, {summary['slots']} slots of {summary['slot_ms']:g} ms",
        "hovered": f"without a quorum {early} slots before it flew, {later} after",
        "sent": f"{summary['sent']} frames" + (f", at most {late:.2f} ms late (99 %)" if late is not None else ""),
        "not sent": reasons(summary["unsent_because"]),
        "heard": f"{summary['heard']} frames of {', '.join(f'cf{k}' for k in summary['heard_of']) or 'no agent'}"
        + (f"; {share:.0%} of the others lately" if share is not None else ""),
        "longest gap": f"{summary['oldest_heard_slots']} slots, of cf{summary['oldest_heard_of']}"
        if summary["oldest_heard_of"]
        else "",
        "not taken in": reasons(summary["not_taken_in"]),
    }
    return "\n".join(f"{name:14}{text}" for name, text in rows.items() if text)


class _Terminal:
    """Standard error: lines about an agent, and on a terminal a last line that changes."""

    def __init__(self, agent: int) -> None:
        self._name, self._clear = f"cf{agent}", "\r\x1b[K" if sys.stderr.isatty() else ""

    def log(self, line: str) -> None:
        """Print a line that stays."""
        print(f"{self._clear}dtsa: {self._name}: {line}", file=sys.stderr, flush=True)

    def show(self, line: str) -> None:
        """Show a line in place of the one before."""
        columns = shutil.get_terminal_size().columns
        print(f"{self._clear}{f'{self._name}: {line}'[: columns - 1]}", end="", file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Take that line away."""
        print(self._clear, end="", file=sys.stderr, flush=True)
