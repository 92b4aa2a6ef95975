"""What soaks check of flights: how they end, that they go on, what their bags hold."""

from __future__ import annotations

import json
import signal
from typing import Any

from dtsa_bench.recordings.bag.recover import recover
from dtsa_bench.recordings.verify import verify_bag

from .flights import Running, until
from .item import NotMet

INTERRUPTED = 130
_GROWTH_BYTES = 2_000


def met(condition: object, what: str) -> None:
    """Something that the reaction promises.

    :raises NotMet: if it does not hold.
    """
    if not condition:
        raise NotMet(what)


def clean_end(flight: Running, code: int, *said: str) -> None:
    """The flight ends by itself with a code, without a traceback, and no process stays.

    :param flight: the flight.
    :param code: its exit code.
    :param said: texts on its standard error.
    """
    found = flight.end()
    text = flight.said()
    met(found == code, f"exit code {found} instead of {code}: {text.strip()[-300:]}")
    met("Traceback" not in text, f"a traceback: {text.strip()[-300:]}")
    for part in said:
        met(part in text, f"it does not say {part!r}: {text.strip()[-300:]}")
    flight.nobody_left()


def flies_on(flight: Running) -> None:
    """The flight goes on: its bag grows.

    :raises NotMet: if it does not.
    """
    size = flight.bag_bytes()
    until(lambda: flight.process.poll() is not None or flight.bag_bytes() > size + _GROWTH_BYTES, "the flight goes on")
    met(flight.process.poll() is None, f"the flight has ended: {flight.said().strip()[-300:]}")


def interrupted_well(flight: Running, number: int = signal.SIGINT) -> dict[str, Any]:
    """A signal ends the flight in good order; its bag is what the protocol gives. Its summary.

    :param flight: the flight.
    :param number: the signal.
    """
    flight.process.send_signal(number)
    clean_end(flight, INTERRUPTED, "interrupted")
    verified(flight)
    return summary(flight)


def summary(flight: Running) -> dict[str, Any]:
    """The results of a flight that has ended."""
    path = flight.out / "summary.json"
    met(path.is_file(), "there is no summary.json")
    return dict(json.loads(path.read_text(encoding="utf-8")))


def verified(flight: Running, slots: int = 1) -> None:
    """The bag is closed and what the protocol gives.

    :param flight: the flight, ended.
    :param slots: it has so many at least.
    """
    result = verify_bag(flight.out / "bag")
    met(result.ok, f"the bag is not what the protocol gives: {result.difference}")
    met(result.slots >= slots, f"the bag has {result.slots} slots")


def recovered(flight: Running) -> None:
    """The bag was not closed; what `recover` makes of it is what the protocol gives up to where it breaks off."""
    result = verify_bag(recover(flight.out / "bag").directory)
    met(result.ok, f"the recovered bag is not what the protocol gives: {result.difference}")
    met(result.broken_off and result.slots, "the recovered bag does not say that it breaks off")
