"""What a verification found."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from dtsa_bench.drawing.card import as_html, as_text
from dtsa_bench.log.rules import RuleChecker


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
