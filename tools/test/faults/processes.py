"""Processes that are killed, stopped, continued and started again, and signals to a flight."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from fly_helpers import ENDLESS, PATIENCE_S, FlightProcess, children, start_flight
from waiting import wait_for

from .row import LOCKSTEP, REALTIME, fault, in_flight

_SUSPENDED_S = 30.0  # by then the middleware has given up processes that are stopped
_FOUND_S = 10.0  # by then an agent that does not find the channel again has ended
# The vehicle of an agent that is dead or hangs hovers in the way; what the others then do is not what a row is about.
_IN_THE_WAY = (*REALTIME, "--no-stop-on-crash")

_ENDS = "the flight ends with code 1 and a line that names it; no process stays; the bag is complete and verifies"
_STOPS = "the flight ends with code 130; no process stays; the bag is complete and verifies"
_RECOVERS = "the agents end, too; `recover` saves the bag, which verifies up to where it breaks off"
_WAIT = "all wait, then fly on; the bag verifies"


def _ends(
    name: str, what: str, words: tuple[str, ...], number: int, pids: Callable[[FlightProcess], Sequence[int]],
    *messages: str, reaction: str = _ENDS, sample: bool = False,
) -> None:  # fmt: skip
    """Declare a row: a signal to processes of a flight with these options ends it, with messages."""

    def act(flight: FlightProcess) -> None:
        killed = pids(flight)
        for pid in killed:
            os.kill(pid, number)
        flight.assert_ends(1, *(message.format(pid=killed[0]) for message in messages))
        flight.assert_verifies()

    act.__name__ = name
    in_flight(what, reaction, *words, sample=sample)(act)


def _pause(flight: FlightProcess, *pids: int, seconds: float = 1.0) -> None:
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    time.sleep(seconds)
    for pid in pids:
        os.kill(pid, signal.SIGCONT)
    flight.assert_flies_on()


_ends("agent_killed", "SIGKILL to an agent's process, lockstep", LOCKSTEP, signal.SIGKILL,
      lambda flight: [flight.pid_of(2)], "cf2 (process {pid}) was killed by SIGKILL", sample=True)  # fmt: skip
_ends("agent_terminated", "SIGTERM to an agent's process, lockstep", LOCKSTEP, signal.SIGTERM,
      lambda flight: [flight.pid_of(2)], "cf2 (process {pid}) ended")  # fmt: skip
_ends("all_agents_killed", "SIGKILL to all agents' processes, lockstep", LOCKSTEP, signal.SIGKILL,
      lambda flight: flight.nodes, "was killed by SIGKILL")  # fmt: skip
_ends("host_killed", "SIGKILL to a process with several agents, lockstep", (*LOCKSTEP, "--processes", "2"),
      signal.SIGKILL, lambda flight: flight.nodes[-1:], "swarm_host_", "was killed by SIGKILL")  # fmt: skip
_ends("agent_hangs", "SIGSTOP to an agent's process, lockstep", (*LOCKSTEP, "--answer-s", "1"), signal.SIGSTOP,
      lambda flight: [flight.pid_of(3)], "cf3 did not answer slot", "within 1 s: dead or hung?",
      reaction=f"after `--answer-s` {_ENDS}", sample=True)  # fmt: skip


@in_flight("SIGSTOP and, 1 s later, SIGCONT to an agent, lockstep", _WAIT, *LOCKSTEP, sample=True)
def agent_paused(flight: FlightProcess) -> None:
    _pause(flight, flight.pid_of(3))
    flight.interrupt()


@in_flight("SIGSTOP and, 1 s later, SIGCONT to the channel, lockstep", _WAIT, *LOCKSTEP)
def channel_paused(flight: FlightProcess) -> None:
    _pause(flight, flight.process.pid)
    flight.interrupt()


@in_flight(
    "SIGSTOP and, 30 s later, SIGCONT to all processes of a flight, lockstep", "it flies on; the bag verifies",
    *LOCKSTEP,
)  # fmt: skip
def flight_suspended(flight: FlightProcess) -> None:
    _pause(flight, flight.process.pid, *flight.nodes, seconds=_SUSPENDED_S)
    time.sleep(_FOUND_S)
    flight.assert_flies_on()
    flight.interrupt()


@in_flight(
    "SIGSTOP and, 1 s later, SIGCONT to the channel, real time",
    "the flight goes on; nobody is taken for lost; the bag verifies", *REALTIME,
)  # fmt: skip
def channel_paused_in_real_time(flight: FlightProcess) -> None:
    _pause(flight, flight.process.pid)
    assert flight.interrupt()["returned_agents"] == []
    assert "not been heard of" not in flight.stderr()


@in_flight("SIGKILL to channel and recorder, lockstep", _RECOVERS, *LOCKSTEP)
def recorder_killed(flight: FlightProcess) -> None:
    flight.process.kill()
    flight.process.wait()
    flight.assert_no_process_left()
    flight.assert_recovered_verifies()


@in_flight("SIGKILL to channel and recorder, real time", _RECOVERS, *REALTIME)
def recorder_killed_in_real_time(flight: FlightProcess) -> None:
    recorder_killed(flight)


@in_flight("SIGKILL to an agent's process, real time", "the flight says so and goes on; the bag verifies", *_IN_THE_WAY)
def agent_killed_in_real_time(flight: FlightProcess) -> None:
    os.kill(flight.pid_of(2), signal.SIGKILL)
    wait_for(lambda: "was killed by SIGKILL; the others fly on" in flight.stderr(), PATIENCE_S)
    flight.assert_flies_on()
    flight.interrupt()


@in_flight(
    "the same with `--respawn`", "the agent takes part again and is named in the summary", *_IN_THE_WAY, "--respawn",
    "0.5",
)  # fmt: skip
def agent_killed_and_started_again(flight: FlightProcess) -> None:
    first = flight.pid_of(2)
    os.kill(first, signal.SIGKILL)
    wait_for(lambda: "cf2 takes part again" in flight.stderr(), PATIENCE_S)
    assert flight.pid_of(2) != first
    assert flight.interrupt()["returned_agents"] == [2]


_ends("all_agents_killed_in_real_time", "SIGKILL to all agents' processes, real time", REALTIME, signal.SIGKILL,
      lambda flight: flight.nodes, "no agent is left",
      reaction="the flight says that no agent is left and ends with code 1; the bag verifies")  # fmt: skip


@in_flight(
    "SIGSTOP to an agent's process until it is missed, then SIGCONT, real time",
    "the flight says so and goes on; the agent takes part again; the bag verifies", *_IN_THE_WAY,
)  # fmt: skip
def agent_stopped_in_real_time(flight: FlightProcess) -> None:
    pid = flight.pid_of(3)
    os.kill(pid, signal.SIGSTOP)
    wait_for(lambda: "cf3 has not been heard of" in flight.stderr(), PATIENCE_S)
    flight.assert_flies_on()
    os.kill(pid, signal.SIGCONT)
    wait_for(lambda: "cf3 takes part again" in flight.stderr(), PATIENCE_S)
    flight.interrupt()


def _signal(directory: Path, number: int, words: tuple[str, ...]) -> None:
    before = signal.signal(number, signal.SIG_DFL)  # under nohup the flight would inherit that it is ignored
    try:
        with start_flight(directory, *words, *ENDLESS) as flight:
            assert flight.interrupt(number)["end"] == "stopped"
    finally:
        signal.signal(number, before)


@fault("SIGINT (Ctrl-C) in flight, lockstep", _STOPS, sample=True)
def sigint(directory: Path) -> None:
    _signal(directory, signal.SIGINT, LOCKSTEP)


@fault("SIGTERM in flight, real time", _STOPS, sample=True)
def sigterm_in_real_time(directory: Path) -> None:
    _signal(directory, signal.SIGTERM, REALTIME)


@fault("SIGHUP (a closed terminal) in flight, lockstep", _STOPS)
def sighup(directory: Path) -> None:
    _signal(directory, signal.SIGHUP, LOCKSTEP)


@in_flight("SIGINT before all agents have answered", "code 130; no process stays", *LOCKSTEP, begun=False, sample=True)
def sigint_during_the_start(flight: FlightProcess) -> None:
    wait_for(lambda: children(flight.process.pid), PATIENCE_S)
    flight.process.send_signal(signal.SIGINT)
    flight.assert_ends(130)


@in_flight("SIGINT three times within 0.1 s", _STOPS, *LOCKSTEP, sample=True)
def three_sigints(flight: FlightProcess) -> None:
    for _ in range(3):
        flight.process.send_signal(signal.SIGINT)
        time.sleep(0.05)
    flight.assert_ends(130)
    flight.assert_verifies()
