"""Who is told what happens on the channel, and who says when the run is over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from dtsa_agent.core.errors import DtsaError
from dtsa_agent.ros.common.wire.report_fields import ReportFields
from dtsa_channel_sim.model.schedule import Change
from dtsa_channel_sim.model.verdict import Verdict

from .answers import Answers


class ObserverError(DtsaError):
    """An observer failed: the run ends, and the error names it.

    :param observer: the observer.
    :param error: what it raised.
    """

    def __init__(self, observer: object, error: Exception) -> None:
        super().__init__(f"{type(observer).__name__} failed: {type(error).__name__}: {error}")


@dataclass(frozen=True, slots=True)
class ChannelStatus:
    """How the channel is doing."""

    slot: int  # the last one opened (lockstep) or closed (real time); -1: none yet
    dropped: dict[str, int]  # messages and frames not taken in, by reason
    awaited: list[int]  # ids of the agents whose answers are missing
    lag_ms: float = 0.0  # by how much the channel is late now, in real time


class ChannelObserver:
    """What the channel tells while a run is under way.

    An observer derives from this class and overrides what it wants to know; the rest does nothing and costs nothing.
    Observers are told in the order in which they were added. None of them can change what happens on the air.
    A slot passes in this order: ``slot_published`` and ``answer_received`` as messages go out and come in,
    ``all_answered``, ``judged``, ``slot_over``.
    """

    def slot_published(self, slot: int, data: bytes, time_ns: int) -> None:
        """A slot message has been sent.

        :param slot: the slot that it opens, or whose frame it delivers.
        :param data: the message as CDR.
        :param time_ns: ns, simulated time.
        """

    def answer_received(self, slot: int, ids: bytes, data: bytes) -> None:
        """A usable transmission message has come in.

        :param slot: the slot that it answers.
        :param ids: the ids of its agents, as in the message.
        :param data: the message as CDR.
        """

    def frame_sent(self, slot: int, data: bytes, time_ns: int) -> None:
        """A usable frame message has come in, in real time only.

        :param slot: the slot whose account it belongs to.
        :param data: the message as CDR.
        :param time_ns: ns, simulated time at which its transmission starts.
        """

    def report(self, message: ReportFields, data: bytes) -> None:
        """A usable report has come in, in real time only.

        :param message: its fields; it may tell of slots that are over.
        :param data: the message as CDR.
        """

    def begun(self, at_s: float) -> None:
        """It is known when slot 0 starts, in real time only.

        :param at_s: s, as ``time.monotonic()`` gives it.
        """

    def stalled(self, from_ns: int, to_ns: int) -> None:
        """The channel stood still, in real time only.

        :param from_ns: ns from the start of slot 0.
        :param to_ns: ns from the start of slot 0.
        """

    def all_answered(self, slot: int, answers: Answers) -> None:
        """All agents (that still live) have answered a slot.

        :param slot: the slot; its answers carry the true motion during the slot before.
        :param answers: the answers; valid during the call.
        """

    def judged(self, slot: int, answers: Answers, frames: dict[int, bytes], verdict: Verdict) -> None:
        """The air has carried a slot's frames.

        :param slot: the slot.
        :param answers: what the agents answered to it; valid during the call.
        :param frames: the frames by the sender's id.
        :param verdict: who received what.
        """

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        """The slot is over: time for what nobody waits for. Arguments as above."""

    def agent_silent(self, agent: int) -> None:
        """An agent has fallen silent, in real time only.

        :param agent: its id.
        """

    def agents_back(self, agents: list[int]) -> None:
        """Agents that had fallen silent report again, in real time only.

        :param agents: their ids.
        """

    def settings_changed(self, change: Change) -> None:
        """A setting of the channel has been changed while it runs.

        :param change: the values, and the first slot in which they hold.
        """

    def idle(self, status: ChannelStatus) -> None:
        """Called about ten times a second, also while nothing comes in.

        :param status: how the channel is doing.
        :raises DtsaError: to end the run with an error.
        """

    def ended(self, slot: int, reason: str, failed: bool) -> None:
        """The run is over; called once, before ``close``.

        :param slot: the last slot begun; -1: none.
        :param reason: why, as people read it.
        :param failed: whether an error has ended it.
        """

    def close(self) -> None:
        """The run is over, whatever the reason; called once. What is open has to be finished here."""


class Referee(Protocol):
    """The one who says when a run is over."""

    def over(self, slot: int, answers: Answers) -> bool:
        """Whether the run ends, asked when all agents have answered a slot and all observers know.

        :param slot: the slot.
        :param answers: the answers; valid during the call.
        """

    @property
    def reason(self) -> str:
        """Why the run ends; empty while it goes on."""
        return ""


class SlotLimit(Referee):
    """Ends a run after a number of slots.

    :param slots: the number; 0: never.
    """

    def __init__(self, slots: int = 0) -> None:
        self._slots = slots
        self._over = False

    def over(self, slot: int, answers: Answers) -> bool:
        self._over = 0 < self._slots <= slot
        return self._over

    @property
    def reason(self) -> str:
        return f"{self._slots} slots have passed" if self._over else ""


class Observers(ChannelObserver):
    """Passes on to any number of observers what the channel tells."""

    def __init__(self) -> None:
        self._all: list[ChannelObserver] = []
        self._told: dict[str, list[tuple[ChannelObserver, Callable[..., None]]]] = {name: [] for name in _EVENTS}

    def add(self, observer: ChannelObserver) -> None:
        """Adds an observer; it is told after those that are there already."""
        self._all.append(observer)
        for name in _EVENTS:
            if getattr(type(observer), name) is not getattr(ChannelObserver, name):
                self._told[name].append((observer, getattr(observer, name)))

    def _tell(self, event: str, *arguments: object) -> None:
        observer: object = None
        try:
            for entry in self._told[event]:
                observer, call = entry
                call(*arguments)
        except DtsaError:
            raise  # says by itself what is wrong
        except Exception as error:
            raise ObserverError(observer, error) from error

    def slot_published(self, slot: int, data: bytes, time_ns: int) -> None:
        self._tell("slot_published", slot, data, time_ns)

    def answer_received(self, slot: int, ids: bytes, data: bytes) -> None:
        self._tell("answer_received", slot, ids, data)

    def frame_sent(self, slot: int, data: bytes, time_ns: int) -> None:
        self._tell("frame_sent", slot, data, time_ns)

    def report(self, message: ReportFields, data: bytes) -> None:
        self._tell("report", message, data)

    def begun(self, at_s: float) -> None:
        self._tell("begun", at_s)

    def stalled(self, from_ns: int, to_ns: int) -> None:
        self._tell("stalled", from_ns, to_ns)

    def all_answered(self, slot: int, answers: Answers) -> None:
        self._tell("all_answered", slot, answers)

    def judged(self, slot: int, answers: Answers, frames: dict[int, bytes], verdict: Verdict) -> None:
        self._tell("judged", slot, answers, frames, verdict)

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        self._tell("slot_over", slot, answers, verdict)

    def agent_silent(self, agent: int) -> None:
        self._tell("agent_silent", agent)

    def agents_back(self, agents: list[int]) -> None:
        self._tell("agents_back", agents)

    def settings_changed(self, change: Change) -> None:
        self._tell("settings_changed", change)

    def idle(self, status: ChannelStatus) -> None:
        self._tell("idle", status)

    def ended(self, slot: int, reason: str, failed: bool) -> None:
        self._tell("ended", slot, reason, failed)

    def close(self) -> None:
        """Closes all observers, also when some of them fail.

        :raises DtsaError: the first failure.
        """
        told, self._told["close"] = self._told["close"], []
        failures = [failure for observer, call in told if (failure := _failure(observer, call))]
        if failures:
            raise failures[0]


def _failure(observer: ChannelObserver, close: Callable[..., None]) -> DtsaError | None:
    """Closes an observer; what went wrong, if anything did."""
    try:
        close()
    except DtsaError as error:
        return error
    except Exception as error:
        failure = ObserverError(observer, error)
        failure.__cause__ = error
        return failure
    return None


_EVENTS = tuple(name for name, member in vars(ChannelObserver).items() if name[0] != "_" and callable(member))
