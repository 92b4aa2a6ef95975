"""Observers of the channel, which are called when something happens."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from typing import Any

from dtsa_agent.core.errors import DtsaError
from dtsa_agent.ros.common.messages import Fields
from dtsa_channel_sim.model.schedule import Change
from dtsa_channel_sim.model.verdict import Verdict

from .answers import Answers


class ObserverError(DtsaError):
    """An observer failed: the run ends, and the error names it."""

    def __init__(self, observer: object, error: Exception) -> None:
        super().__init__(f"{type(observer).__name__} failed: {type(error).__name__}: {error}")


class ChannelObserver:
    """Events of a run. An observer derives from this class and overrides those that it needs.

    Observers are called in the order in which they were added. None of them can change what happens on the air. A slot
    passes in this order: ``all_answered``, ``arbitrated``, ``slot_over``. Answers are valid during the call.
    """

    def frame_sent(self, slot: int, sender: int, data: bytes, start_ns: int) -> None:
        """A frame goes on the air, in real time only: slot that its sender counts, start from that of slot 0."""

    def report(self, message: Fields) -> None:
        """A usable report has come in, in real time only; it may be of slots that are over."""

    def start_known(self, at_s: float) -> None:
        """It is known when slot 0 starts, s of ``time.monotonic()``, in real time only."""

    def all_answered(self, slot: int, answers: Answers) -> None:
        """All connected agents have answered a slot, with the true motion during the slot before."""

    def arbitrated(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        """The air has carried a slot's frames, those in ``answers``."""

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        """The slot is over: time for what no agent waits for."""

    def agent_silent(self, agent: int) -> None:
        """An agent has fallen silent, in real time only."""

    def agents_back(self, agents: list[int]) -> None:
        """Agents that had fallen silent report again, in real time only."""

    def settings_changed(self, change: Change) -> None:
        """A setting of the channel has been changed while it runs."""

    def idle(self, slot: int, awaited: list[int]) -> None:
        """Called about ten times a second, also while nothing comes in; a DtsaError ends the run.

        :param slot: the last one opened (lockstep) or closed (real time); -1: none yet.
        :param awaited: ids of the agents whose answers are missing.
        """

    def ended(self, slot: int, reason: str, failed: bool) -> None:
        """The run is over after this slot (-1: none), by an error if ``failed``; called once, before ``close``."""

    def close(self) -> None:
        """The run is over, whatever the reason; called once. What is open has to be finished here."""


class Observers(ChannelObserver):
    """Passes every event on to any number of observers; an error of one that is no DtsaError names it."""

    def __init__(self) -> None:
        self._observers: list[ChannelObserver] = []
        for event in vars(ChannelObserver):
            if event[0] != "_" and event != "close":
                setattr(self, event, partial(self._notify, event))

    def add(self, *observers: ChannelObserver) -> None:
        """Add observers; they are called in this order, after those that are there already."""
        self._observers += observers

    def _notify(self, event: str, *arguments: Any) -> None:
        for observer in self._observers:
            _call(observer, event, *arguments)

    def close(self) -> None:
        """Close all observers, once, also when some of them fail.

        :raises DtsaError: a failure.
        """
        with ExitStack() as stack:
            while self._observers:
                stack.callback(_call, self._observers.pop(), "close")


def _call(observer: ChannelObserver, event: str, *arguments: Any) -> None:
    try:
        getattr(observer, event)(*arguments)
    except DtsaError:
        raise
    except Exception as error:
        raise ObserverError(observer, error) from error
