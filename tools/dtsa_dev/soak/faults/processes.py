"""Processes that are killed, stopped, continued and started again, and signals to a flight."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from dtsa_dev.soak.checks import clean_end, flies_on, interrupted_well, met, recovered, verified
from dtsa_dev.soak.flights import ENDLESS, PATIENCE_S, Running, children, flying, until

from .fault import LOCKSTEP, REALTIME, Fault

_STOPPED_S = 1.0
_SUSPENDED_S = 30.0  # by then the middleware has given up who is stopped
_FOUND_S = 10.0  # by then an agent that does not find the channel again has ended
# The vehicle of an agent that is dead or hangs hovers in the way; what the others then do is not what a row is about.
_IN_THE_WAY = (*REALTIME, "--no-stop-on-crash")


def _during(*words: str, begun: bool = True) -> Callable[[Callable[[Running], None]], Callable[[Path], None]]:
    """Makes the `run` of a fault from what is done to a flight with these options, which does not end by itself."""

    def fault(act: Callable[[Running], None]) -> Callable[[Path], None]:
        def run(directory: Path) -> None:
            with flying(directory, *words, *ENDLESS, begun=begun) as flight:
                act(flight)

        return run

    return fault


@_during(*LOCKSTEP)
def _agent_killed(flight: Running) -> None:
    victim = flight.pid_of(2)
    os.kill(victim, signal.SIGKILL)
    clean_end(flight, 1, f"cf2 (process {victim}) was killed by SIGKILL")
    verified(flight)


@_during(*LOCKSTEP)
def _agent_asked_to_end(flight: Running) -> None:
    victim = flight.pid_of(2)
    os.kill(victim, signal.SIGTERM)
    clean_end(flight, 1, f"cf2 (process {victim}) ended")
    verified(flight)


@_during(*LOCKSTEP)
def _all_agents_killed(flight: Running) -> None:
    for pid in flight.known:
        os.kill(pid, signal.SIGKILL)
    clean_end(flight, 1, "was killed by SIGKILL")
    verified(flight)


@_during(*LOCKSTEP, "--processes", "2")
def _host_killed(flight: Running) -> None:
    os.kill(flight.known[-1], signal.SIGKILL)
    clean_end(flight, 1, "swarm_host_", "was killed by SIGKILL")
    verified(flight)


@_during(*LOCKSTEP, "--answer-s", "1")
def _agent_hangs(flight: Running) -> None:
    os.kill(flight.pid_of(3), signal.SIGSTOP)
    clean_end(flight, 1, "cf3 did not answer slot", "within 1 s: dead or hung?")
    verified(flight)


@_during(*LOCKSTEP)
def _agent_paused(flight: Running) -> None:
    pid = flight.pid_of(3)
    os.kill(pid, signal.SIGSTOP)
    time.sleep(_STOPPED_S)
    os.kill(pid, signal.SIGCONT)
    flies_on(flight)
    interrupted_well(flight)


@_during(*LOCKSTEP)
def _channel_paused(flight: Running) -> None:
    flight.process.send_signal(signal.SIGSTOP)
    time.sleep(_STOPPED_S)
    flight.process.send_signal(signal.SIGCONT)
    flies_on(flight)
    interrupted_well(flight)


@_during(*LOCKSTEP)
def _suspended(flight: Running) -> None:
    everybody = (flight.process.pid, *flight.known)
    for pid in everybody:
        os.kill(pid, signal.SIGSTOP)
    time.sleep(_SUSPENDED_S)
    for pid in everybody:
        os.kill(pid, signal.SIGCONT)
    flies_on(flight)
    time.sleep(_FOUND_S)
    flies_on(flight)
    interrupted_well(flight)


@_during(*REALTIME)
def _channel_paused_in_real_time(flight: Running) -> None:
    flight.process.send_signal(signal.SIGSTOP)
    time.sleep(_STOPPED_S)
    flight.process.send_signal(signal.SIGCONT)
    flies_on(flight)
    found = interrupted_well(flight)
    met("not been heard of" not in flight.said(), "agents are taken for lost because the channel stood still")
    met(found["returned_agents"] == [], "agents have come back that were never away")


def _recorder_killed(flight: Running) -> None:
    flight.process.kill()
    flight.process.wait()
    flight.nobody_left()
    recovered(flight)


@_during(*_IN_THE_WAY)
def _agent_killed_in_real_time(flight: Running) -> None:
    os.kill(flight.pid_of(2), signal.SIGKILL)
    until(lambda: "was killed by SIGKILL; the others fly on" in flight.said(), "it says that cf2 is gone")
    flies_on(flight)
    interrupted_well(flight)


@_during(*_IN_THE_WAY, "--respawn", "0.5")
def _agent_killed_and_started_again(flight: Running) -> None:
    first = flight.pid_of(2)
    os.kill(first, signal.SIGKILL)
    until(lambda: "cf2 takes part again" in flight.said(), "cf2 takes part again")
    met(flight.pid_of(2) != first, "the same process")
    met(interrupted_well(flight)["returned_agents"] == [2], "the summary does not name cf2 as returned")


@_during(*REALTIME)
def _all_agents_killed_in_real_time(flight: Running) -> None:
    for pid in flight.known:
        os.kill(pid, signal.SIGKILL)
    clean_end(flight, 1, "nobody is left")
    verified(flight)


@_during(*_IN_THE_WAY)
def _agent_stopped_in_real_time(flight: Running) -> None:
    pid = flight.pid_of(3)
    os.kill(pid, signal.SIGSTOP)
    until(lambda: "cf3 has not been heard of" in flight.said(), "it says that cf3 is silent")
    flies_on(flight)
    os.kill(pid, signal.SIGCONT)
    until(lambda: "cf3 takes part again" in flight.said(), "cf3 takes part again")
    interrupted_well(flight)


def _signalled(number: int, words: tuple[str, ...]) -> Callable[[Path], None]:
    run = _during(*words)(lambda flight: met(interrupted_well(flight, number)["end"] == "stopped", "no end"))

    def heeded(directory: Path) -> None:
        ignored = signal.getsignal(number) == signal.SIG_IGN  # as under nohup: the flight would inherit it
        if ignored:
            signal.signal(number, signal.SIG_DFL)
        try:
            run(directory)
        finally:
            if ignored:
                signal.signal(number, signal.SIG_IGN)

    return heeded


@_during(*LOCKSTEP, begun=False)
def _signal_during_the_start(flight: Running) -> None:
    until(lambda: children(flight.process.pid), "processes are started", PATIENCE_S)
    flight.process.send_signal(signal.SIGINT)
    clean_end(flight, 130)


@_during(*LOCKSTEP)
def _three_signals(flight: Running) -> None:
    for _ in range(3):
        flight.process.send_signal(signal.SIGINT)
        time.sleep(0.05)
    clean_end(flight, 130)
    verified(flight)


_ENDS = "the flight ends with code 1 and a line that names it; no process stays; the bag is complete and verifies"
_STOPS = "the flight ends with code 130; no process stays; the bag is complete and verifies"
_RECOVERS = "the agents end, too; `recover` saves the bag, which verifies up to where it breaks off"

FAULTS = (
    Fault("agent killed, lockstep", "SIGKILL to an agent's process, lockstep", _ENDS, _agent_killed, True),
    Fault("agent asked to end, lockstep", "SIGTERM to an agent's process, lockstep", _ENDS, _agent_asked_to_end),
    Fault("all agents killed, lockstep", "SIGKILL to all agents' processes, lockstep", _ENDS, _all_agents_killed),
    Fault("host killed, lockstep", "SIGKILL to a process with several agents, lockstep", _ENDS, _host_killed),
    Fault("agent hangs, lockstep", "SIGSTOP to an agent's process, lockstep",
          "after `--answer-s` " + _ENDS, _agent_hangs, True),
    Fault("agent paused, lockstep", "SIGSTOP and, 1 s later, SIGCONT to an agent, lockstep",
          "all wait, then fly on; the bag verifies", _agent_paused, True),
    Fault("channel paused, lockstep", "SIGSTOP and, 1 s later, SIGCONT to the channel, lockstep",
          "all wait, then fly on; the bag verifies", _channel_paused),
    Fault("flight suspended, lockstep", "SIGSTOP and, 30 s later, SIGCONT to all processes of a flight, lockstep",
          "it flies on; the bag verifies", _suspended),
    Fault("channel paused, real time", "SIGSTOP and, 1 s later, SIGCONT to the channel, real time",
          "the flight goes on; nobody is taken for lost; the bag verifies", _channel_paused_in_real_time),
    Fault("recorder killed, lockstep", "SIGKILL to channel and recorder, lockstep", _RECOVERS,
          _during(*LOCKSTEP)(_recorder_killed)),
    Fault("recorder killed, real time", "SIGKILL to channel and recorder, real time", _RECOVERS,
          _during(*REALTIME)(_recorder_killed), True),
    Fault("agent killed, real time", "SIGKILL to an agent's process, real time",
          "the flight says so and goes on; the bag verifies", _agent_killed_in_real_time),
    Fault("agent killed and started again, real time", "the same with `--respawn`",
          "the agent takes part again and is named in the summary", _agent_killed_and_started_again),
    Fault("all agents killed, real time", "SIGKILL to all agents' processes, real time",
          "the flight says that nobody is left and ends with code 1; the bag verifies",
          _all_agents_killed_in_real_time),
    Fault("agent stopped, real time", "SIGSTOP to an agent's process until it is missed, then SIGCONT, real time",
          "the flight says so and goes on; the agent takes part again; the bag verifies", _agent_stopped_in_real_time),
    Fault("SIGINT, lockstep", "SIGINT (Ctrl-C) in flight, lockstep", _STOPS, _signalled(signal.SIGINT, LOCKSTEP),
          True),
    Fault("SIGTERM, real time", "SIGTERM in flight, real time", _STOPS, _signalled(signal.SIGTERM, REALTIME), True),
    Fault("SIGHUP, lockstep", "SIGHUP (a closed terminal) in flight, lockstep", _STOPS,
          _signalled(signal.SIGHUP, LOCKSTEP)),
    Fault("SIGINT during the start", "SIGINT before all agents have answered", "code 130; no process stays",
          _signal_during_the_start, True),
    Fault("three SIGINT", "SIGINT three times within 0.1 s", _STOPS, _three_signals, True),
)  # fmt: skip
