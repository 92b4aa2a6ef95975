"""What a verification found: how often fields are equal, and the first one that differs, in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import REASONS, RemoteProtocolError, decode_frame
from dtsa_agent.core.frame import TAG_LENGTH, decode_extended
from dtsa_bench.drawing.card import as_html, as_text
from dtsa_bench.log.arrays import FlightArrays
from dtsa_bench.log.rules import RuleChecker

_MOTION = "the vehicle model under the agent's own commands"
_CHOICE = "what the policy gives from what the agent heard"
WHY = {
    "length": "frames have the length of their profile, and only chosen agents send",
    "frame": "the codec's bytes of the sender's state",
    "received": "the channel's draw from its seed for this slot",
    "lost": "the channel's draw from its seed for this slot",
    "collided": "two frames in one slot destroy each other",
    "outcome": "the number of senders decides",
    "chosen": _CHOICE,
    "reason": _CHOICE,
    "digest": "the agent's table after all that it heard",
    "score": "priority value g of the chosen (eq:permission_d_p_ang)",
    "track": _MOTION,
    "velocity": _MOTION,
    "command": "the avoider, from own state and estimates (eq:estimate)",
    "goal": "the scenario",
}


@dataclass(frozen=True, slots=True)
class Difference:
    """The first place where a bag is not what the protocol gives."""

    what: str  # what was compared, e.g. "chosen"
    expected: str
    recorded: str
    reason: str  # why the expected value is what it is
    slot: int | None = None
    agent: int | None = None  # id

    def __str__(self) -> str:
        known = {name: place for name, place in (("slot", self.slot), ("agent", self.agent)) if place is not None}
        where = f"{', '.join(f'{name} {place}' for name, place in known.items())}: " if known else ""
        return f"{where}{self.what}: expected {self.expected}, recorded {self.recorded} ({self.reason})"


class Mismatch(Exception):
    """Carries the first difference out of nested checks; arguments are those of :class:`Difference`."""

    def __init__(
        self, what: str, expected: object, recorded: object, reason: str, slot: int | None = None,
        agent: int | None = None,
    ) -> None:  # fmt: skip
        self.difference = Difference(what, str(expected), str(recorded), reason, slot, agent)
        super().__init__(str(self.difference))


@dataclass(slots=True, repr=False)
class Result:
    """What was checked, how often, what was not and why, and the first difference if there is one."""

    bag: str
    mode: str
    slots: int = 0
    simulated_s: float = 0.0
    wall_time_s: float = 0.0
    checked: dict[str, int] = field(default_factory=dict)  # what was compared and found equal -> how often
    skipped: dict[str, str] = field(default_factory=dict)  # what was not checked -> why
    safety: dict[str, Any] = field(default_factory=dict)
    broken_off: bool = False  # the recorder was stopped before it had finished: checked up to there
    unheard: str = ""  # why the agents did not hear each other; empty: they did
    difference: Difference | None = None

    def __repr__(self) -> str:
        return as_text(self._title, self._rows())

    def _repr_html_(self) -> str:
        return as_html(self._title, self._rows())

    @property
    def _title(self) -> str:
        if not self.ok:
            return f"{self.bag}: NOT what the protocol gives"
        cut = f", up to slot {self.slots - 1}, where the recording breaks off" if self.broken_off else ""
        return f"{self.bag}: everything is what the protocol gives{cut}"

    def _rows(self) -> list[tuple[str, str]]:
        pace = self.simulated_s / self.wall_time_s if self.wall_time_s else 0.0
        took = f"{self.simulated_s:.2f} s in {self.wall_time_s:.2f} s ({pace:.0f} x)"
        rows = [("checked", f"{self.mode}, {self.slots} slots, {took}")]
        if self.checked:
            rows.append(("equal", ", ".join(f"{count} {what}" for what, count in self.checked.items())))
        rows += [("not checked", f"{what}: {why}") for what, why in self.skipped.items()]
        for what, value in self.safety.items():
            rows.append((what.replace("_", " "), f"{value:.3f}" if isinstance(value, float) else str(value)))
        rows += [("hearing", self.unheard)] if self.unheard else []
        return rows if self.difference is None else [*rows, ("first difference", str(self.difference))]

    @property
    def ok(self) -> bool:
        """Nothing differs."""
        return self.difference is None

    def count(self, what: str, times: int = 1) -> None:
        """Note checks that passed.

        :param what: what was checked, as the result names it.
        :param times: how often.
        """
        self.checked[what] = self.checked.get(what, 0) + times

    def note_rules(self, rules: RuleChecker) -> None:
        """Note whether the frames kept to the policy's rules.

        :param rules: the rules, after all frames.
        :raises Mismatch: at the first rules that were broken.
        """
        if not rules.has_rules:
            return
        if rules.broken:
            why = "a turn is its owner's, or of the last agent that was given it (docs/reference/protocol.md)"
            raise Mismatch("frames", "none against the rules", "; ".join(rules.broken[:3]), why)
        self.count("slots whose frames keep to the rules", rules.slots)
        if rules.unchecked:
            why = "they may depend on frames that were too late to be sent, and are in no record"
            self.skipped["frames against the rules"] = f"in {rules.unchecked} slots: {why}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {"bag": self.bag, "mode": self.mode, "ok": self.ok, **asdict(self), "unheard": self.unheard or None}


def first_difference(log: FlightArrays, expected: Mapping[str, NDArray[Any]], why: str = "") -> Mismatch | None:
    """The difference in the earliest slot between a log and what its fields should be, to the bit; None: all is equal.

    :param expected: arrays by the log's names; they have a row a slot, `received` a row a frame.
    :param why: the reason of all differences; "": that of the field.
    """
    differences = []
    for name, right in expected.items():
        recorded = getattr(log, name)
        if right.shape != recorded.shape or right.tobytes() == recorded.tobytes():
            continue  # with other frames than expected their length differs
        bits = [np.ascontiguousarray(values).view(np.uint8).reshape(*right.shape, -1) for values in (right, recorded)]
        place = tuple(int(index[0]) for index in np.nonzero((bits[0] != bits[1]).any(axis=-1)))
        row, what, reason = place[0], name, why or WHY[name]
        if name == "received":
            row, sender = (int(values[place[0]]) for values in log.sent_frames[:2])
            what = f"received, frame of cf{sender}"
        if name == "chosen":
            reason += f"; reason: {_reason_text(int(log.reason[place]))}"
        agent = place[-1] + 1 if len(place) > 1 else None
        pair = right[place].item(), recorded[place].item()
        differences.append(field_mismatch(what, *pair, reason, row, agent, log))
    return min(differences, key=lambda found: found.difference.slot or 0, default=None)


def field_mismatch(
    name: str, expected: Any, recorded: Any, why: str, slot: int, agent: int | None, log: FlightArrays
) -> Mismatch:  # fmt: skip
    """A field of an agent that is not as expected; frames are bytes."""
    return Mismatch(name, _shown(name, expected, log), _shown(name, recorded, log), why, slot, agent)


def _shown(name: str, value: Any, log: FlightArrays) -> str:
    """A value of a field in words."""
    if name == "frame":
        return _describe_frame(value, log) if value else "none"
    return f"{value} ({_reason_text(value)})" if name == "reason" else repr(value)


def _reason_text(code: int) -> str:
    return REASONS[code] if code < len(REASONS) else "no reason"


def _describe_frame(data: bytes, log: FlightArrays) -> str:
    """A frame as its bytes and its fields, sealed or not."""
    config, why = log.config.swarm, ""
    decode = decode_extended if config.extended else decode_frame
    for end, seal in ((len(data), ""), (len(data) - TAG_LENGTH, ", sealed")):
        try:
            return f"{data.hex()} ({decode(config.protocol_part(data[:end]), config.extent_m)}{seal})"
        except RemoteProtocolError as error:  # noqa: PERF203
            why = why or str(error)
    return f"{data.hex()} (no frame: {why})"
