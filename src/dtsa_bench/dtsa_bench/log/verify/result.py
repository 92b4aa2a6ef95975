"""What a verification found."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dtsa_bench.drawing.card import as_html, as_text
from dtsa_bench.log.rules import Judge


@dataclass(frozen=True, slots=True)
class Difference:
    """The first place where a bag is not what the protocol gives."""

    what: str  # what was compared, e.g. "transmission.chosen"
    expected: str
    recorded: str
    reason: str  # why the expected value is what it is
    slot: int | None = None
    agent: int | None = None  # id

    def __str__(self) -> str:
        place = ", ".join(
            text
            for text in (
                "" if self.slot is None else f"slot {self.slot}",
                "" if self.agent is None else f"agent {self.agent}",
            )
            if text
        )
        where = f"{place}: " if place else ""
        return f"{where}{self.what}: expected {self.expected}, recorded {self.recorded} ({self.reason})"

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {
            "slot": self.slot,
            "agent": self.agent,
            "what": self.what,
            "expected": self.expected,
            "recorded": self.recorded,
            "reason": self.reason,
        }


class Mismatch(Exception):
    """Carries the first difference out of nested checks."""

    def __init__(self, difference: Difference) -> None:
        super().__init__(str(difference))
        self.difference = difference


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
        verdict = "everything is what the protocol gives" if self.ok else "NOT what the protocol gives"
        cut = self.broken_off and self.ok
        return f"{self.bag}: {verdict}" + (
            f", up to slot {self.slots - 1}, where the recording breaks off" if cut else ""
        )

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
        """Notes checks that passed."""
        self.checked[what] = self.checked.get(what, 0) + times

    def take_judgement(self, judge: Judge) -> None:
        """Notes whether the frames kept to the policy's rules.

        :raises Mismatch: at the first rules that were broken.
        """
        if not judge.knows_rules:
            return
        if judge.broken:
            why = "a turn is its owner's, or of the last one to whom it was given (docs/reference/protocol.md)"
            raise Mismatch(Difference("frames", "none against the rules", "; ".join(judge.broken[:3]), why))
        self.count("slots whose frames keep to the rules", judge.slots)
        if judge.unjudged:
            why = "they may depend on frames that were too late to be sent, and that nobody has recorded"
            self.skipped["frames against the rules"] = f"in {judge.unjudged} slots: {why}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {
            "bag": self.bag,
            "mode": self.mode,
            "ok": self.ok,
            "slots": self.slots,
            "broken_off": self.broken_off,
            "simulated_s": self.simulated_s,
            "wall_time_s": self.wall_time_s,
            "checked": self.checked,
            "skipped": self.skipped,
            "safety": self.safety,
            "unheard": self.unheard or None,
            "difference": self.difference.to_dict() if self.difference else None,
        }
