"""What the demo's picture, page and animation say; every number in it comes from the flights."""

from __future__ import annotations

from dataclasses import dataclass

from .flown import Flights, Flown
from .story import AGENTS, KILLED, LIVE_AGENTS, LIVE_SLOT_MS, Step

TITLE = "One radio channel, twelve quadcopters: who speaks next?"
INTRO = (
    "Quadcopters that fly across each other's way must know where the others are. They tell each other by radio, on "
    "one channel: time is cut into slots of 10 ms, and in each slot one of them can send its position and velocity."
)


@dataclass(frozen=True, slots=True)
class Line:
    """One flight in a step: what it does, and its figure."""

    name: str
    does: str
    value: str  # its figure, with unit
    meaning: str  # of the figure


def lines(step: Step, flights: Flights) -> list[Line]:
    """What is said about each flight of a step.

    :param step: the step.
    :param flights: all flights.
    """
    found = [flights[take.key] for take in step.takes]
    return [_LINES[flown.take.key](flown) for flown in found]


def sentence(step: Step, flights: Flights) -> str:
    """What a step shows, in a sentence or two.

    :param step: the step.
    :param flights: all flights.
    """
    return _SENTENCES[step.letter](flights)


def error(flown: Flown) -> str:
    """Mean error of what agents think of each other's position."""
    millimetres = 1000.0 * float(flown.summary["estimate_error_mean_m"])
    return f"{millimetres:.0f} mm" if millimetres >= 9.95 else f"{millimetres:.1f} mm"


def age(flown: Flown) -> str:
    """Mean age of what agents know of those that fly."""
    return f"{flown.summary['age_mean_slots']:.1f} slots"


def agreement(flown: Flown) -> str:
    """Share of slots in which all agents take the same one for the sender."""
    return f"{100 * flown.summary['agreement_share']:.0f} %"


_AGE, _ERROR = "mean age of what is known of those that fly", "mean error of where others are thought to be"
_LINES = {
    "all-tdma-hold": lambda f: Line("TDMA, as published", "others stand where last heard", error(f), _ERROR),
    "all-tdma": lambda f: Line("TDMA, extrapolated", "others fly on as last heard", error(f), _ERROR),
    "two-tdma": lambda f: Line("TDMA", "everybody in turn", age(f), _AGE),
    "two-dtsa": lambda f: Line("DTSA", "whose state is most urgent", age(f), _AGE),
    "two-lease": lambda f: Line("lease", "who hovers lends its turns", age(f), _AGE),
    "loss-tdma": lambda f: Line("TDMA", "everybody in turn", error(f), _ERROR),
    "loss-dtsa": lambda f: Line("DTSA", "all must choose alike", error(f), _ERROR),
    "loss-lease": lambda f: Line("lease", "each owner decides alone", error(f), _ERROR),
    "killed-lease": lambda f: Line("lease", "the next one alive takes over", "", ""),
}


def _guess(flights: Flights) -> str:
    before, after = error(flights["all-tdma-hold"]), error(flights["all-tdma"])
    return (
        f"In round robin (TDMA) each is heard every {AGENTS}th slot. Who takes the others to stand where they were "
        f"last heard is wrong by {before} on average; who lets them fly on as they last said, by {after}, with the "
        "same messages."
    )


def _urgent(flights: Flights) -> str:
    two = [age(flights[f"two-{name}"]) for name in ("tdma", "dtsa", "lease")]
    return (
        f"Round robin gives ten of twelve slots to quadcopters that have nothing new to say: what is known of the "
        f"flying two is {two[0]} old. DTSA lets every quadcopter compute whose state is most urgent: {two[1]}. With "
        f"lease a hovering quadcopter lends its turns to a flying one: {two[2]}."
    )


def _lost(flights: Flights) -> str:
    dtsa, lease = flights["loss-dtsa"], flights["loss-lease"]
    return (
        f"DTSA works as long as all know the same. After the first lost message they do not: all agree in "
        f"{agreement(dtsa)} of the slots, {_at_once(dtsa)} or nobody does, positions are wrong by {error(dtsa)}. With "
        f"lease only whose turn it is gives it away, in its own message: {_at_once(lease)}, {error(lease)}. Round "
        f"robin does not mind losses, but is slow: {error(flights['loss-tdma'])}."
    )


def _at_once(flown: Flown) -> str:
    slots = flown.summary["slots"]
    return (
        f"two speak at once in {slots['collision']} of {slots['total']} slots"
        if slots["collision"]
        else "no two speak at once"
    )


def _killed(flights: Flights) -> str:
    times = flights["killed-lease"].times
    assert times is not None
    back = "" if times.back_s is None or times.killed_s is None else f" {times.back_s - times.killed_s:.1f} s later"
    return (
        f"The turns of quadcopter {KILLED} stay empty until the others take it for dead; then the next one alive uses "
        f"them. Started again it listens, speaks{back}, and has its turns back."
    )


_SENTENCES = {"a": _guess, "b": _urgent, "c": _lost, "d": _killed}
LIVE_NOTE = (
    f"Live, in real time: {LIVE_AGENTS} processes, slots of {LIVE_SLOT_MS:g} ms. Its figures describe this machine; "
    "those above are the same everywhere."
)
