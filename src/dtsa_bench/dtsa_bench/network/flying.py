"""One agent on a network: it flies, or only checks who is heard.

What is needed before or after a flight alone is imported there: many agents on one computer share little memory.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from dtsa_agent.air.driver import LiveAgent
from dtsa_agent.air.port import PortSettings, open_port
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import SwarmConfig
from dtsa_agent.stop import Stop


def check(own: AgentSettings, config: SwarmConfig, port: PortSettings, seconds: float, as_json: bool) -> int:
    """Fly with the vehicle held, and print who is heard, and by whom.

    :param seconds: for so long; 0: as long as it takes.
    :param as_json: print the result as JSON.
    :returns: the exit code: 0 if all hear all in time.
    :raises ConfigError: for a port or an id that cannot be used.
    """
    from .check import Check, HeldVehicle, lasts_s, table

    own = dataclasses.replace(own, duration_s=seconds or lasts_s(config), quorum="0")  # it hovers anyway
    log = _Terminal(own.id).log
    log(f"checks for {own.duration_s:.0f} s who is heard; its vehicle is held")
    watcher = Check(own.id, config, port.properties)
    with Stop() as stop, open_port(port) as opened:
        LiveAgent(own, config, opened, watcher, HeldVehicle(), log=log).run(stop)
    result = watcher.result()
    print(json.dumps(result, indent=2) + "\n" if as_json else table(result), end="")
    if result["missing"]:
        log(f"not all hear all in time: {'; '.join(result['missing'])}")
    return int(bool(result["missing"]))


def fly(own: AgentSettings, config: SwarmConfig, port: PortSettings, out: str | None, as_json: bool) -> int:
    """Fly until a signal comes, and print what came of it.

    :param out: directory for its bag and summary; None: there are none.
    :param as_json: print the summary as JSON.
    :returns: the exit code: 0 if it has heard what arrived, and has flown.
    :raises ConfigError: for a port, a directory or an id that cannot be used.
    :raises BagError: if the record is not whole.
    """
    terminal = _Terminal(own.id)
    with Stop() as stop, open_port(port) as opened:
        agent = LiveAgent(own, config, opened, log=terminal.log, show=terminal.show if sys.stderr.isatty() else None)
        record: AbstractContextManager[Any] = nullcontext()
        if out is not None:
            from dtsa_bench.log.agent_bag import recorded

            record = recorded(out, agent, port)
        with record as recorder:
            agent.run(stop)
        summary = agent.summary() if recorder is None else recorder.summary
    from dtsa_bench.runs.delivery import counts_of_datagrams

    terminal.clear()
    print(json.dumps(summary, indent=2) if as_json else brief(summary))
    not_taken_in = summary["not_taken_in"]
    # Two: this agent, and all others.
    hearing = counts_of_datagrams(2, summary["slots"], summary["sent"], summary["heard"], not_taken_in)
    heard_too_little = hearing.problem(not_taken_in) if hearing.delivered else ""  # who is alone hears nobody
    if problem := heard_too_little or summary["never_flew"]:
        terminal.log(problem)
    if recorder is not None and recorder.failure:
        from dtsa_bench.log.bag.errors import BagError

        raise BagError(recorder.failure)
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
