"""What the ground tells the app on board, by parameters and the app channel, until it has confirmed it."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from typing import Any

from dtsa_agent.crazyflie.settings.on_board import START

from .outbox import LinkError

_ANSWER_S = 0.5  # longest wait for the answer to an order
_TIMES = 4  # that an order is sent
_SET_S = 5.0  # longest wait until all parameters are confirmed


class BoardOrders:
    """For one Crazyflie; called in its link's worker, on the ground.

    :param parameters: values of the app's parameters, `group.name`.
    :param orders: packets of the app channel before the start.
    :param polls_hz: Hz, how often the Crazyflie is asked once its agent has started.
    """

    def __init__(self, parameters: Mapping[str, float], orders: Sequence[bytes], polls_hz: float) -> None:
        self._parameters, self._orders = dict(parameters), tuple(orders)
        self.polls_hz = polls_hz

    def prepare(self, cf: Any) -> None:
        """Everything that the app has to know before its agent starts.

        :raises LinkError: it has no such app, or the app refuses.
        """
        missing, confirmed = set(self._parameters), threading.Event()

        def note(name: str, value: str) -> None:
            missing.discard(name)
            if not missing:
                confirmed.set()

        for name, value in self._parameters.items():
            cf.param.add_update_callback(*name.split("."), cb=note)
            try:
                cf.param.set_value(name, value)
            except (KeyError, AttributeError) as error:
                raise LinkError(f"parameter {name} of the app on board: {error}") from error
        if not confirmed.wait(_SET_S):
            raise LinkError(f"not confirmed: {', '.join(sorted(missing))}")
        for name in self._parameters:
            cf.param.remove_update_callback(*name.split("."), cb=note)
        for order in self._orders:
            _tell(cf, order)

    def start(self, cf: Any) -> None:
        """Its agent starts: it listens, then takes part.

        :raises LinkError: it does not.
        """
        _tell(cf, START)


def _tell(cf: Any, order: bytes) -> None:
    answers: list[bytes] = []
    answered = threading.Event()

    def hear(data: Any) -> None:
        if bytes(data)[:1] == order[:1]:
            answers.append(bytes(data))
            answered.set()

    cf.appchannel.packet_received.add_callback(hear)
    try:
        for _ in range(_TIMES):
            cf.appchannel.send_packet(order)
            if answered.wait(_ANSWER_S):
                break
    finally:
        cf.appchannel.packet_received.remove_callback(hear)
    if not answers:
        raise LinkError(f"the app on board does not answer order {order[:1].decode()}")
    if answers[0][1:2] != b"\x01":
        raise LinkError(
            f"the app on board refuses order {order[:1].decode()}: {answers[0][2:].decode(errors='replace')}"
        )
