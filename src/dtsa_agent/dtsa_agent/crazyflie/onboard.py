"""The protocol on board of Crazyflies: its settings, and the set-up that the ground sends to each app before the start.

The app is in `dtsa_agent/onboard`; docs/how-to/on-board.md explains its parameters and orders.
"""

from __future__ import annotations

import queue
import struct
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtsa_agent.air.port import PortProperties, check_fits, header_of
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.declaration import Settings, check, setting
from dtsa_agent.core.settings.scenario import Scenario, policy_key
from dtsa_agent.keys import VARIABLE, authenticator, check_session

from .addresses import LinkError

MAX_AGENTS = 20  # AGENTS_MAX of app.c
POLICIES = ("tdma", "dtsa", "age", "aloha", "lease")  # numbers of libdtsa
ESTIMATORS = ("hold", "linear")
KEY_BYTES = 16
FLIGHT_US = 1500  # of a frame, from the app that sends it to the apps that receive it
ENABLE = "dtsa.enable"  # parameter of the app: whether its agent steers
START = b"S"  # order that starts the agent
#: Has the name of a computer's Crazyradio port: both share one channel and one datagram header.
PORT = PortProperties("crazyradio", FLIGHT_US * 1000, 0, agreed_bytes=2, peers=0, longest=60, bare_sealed=True)
_MARGIN_M = 0.8  # of the box around all starts and goals
_ANSWER_TIMEOUT_S = 0.5  # for the answer to an order
_ATTEMPTS = 4  # to send an order
_CONFIRM_TIMEOUT_S = 5.0  # until all parameters are confirmed


@dataclass(frozen=True, slots=True)
class OnboardSettings(Settings):
    """Crazyflies whose agents run on board."""

    swarm: Mapping[str, Any] = setting(
        {}, "settings of the swarm, as for `dtsa simulate`, without `agents`; empty: no Crazyflie steers itself",
        kind="structure",
    )  # fmt: skip
    polls_hz: float = setting(
        10.0, "packets a second to each Crazyflie from the start of its agent on: they take air from the agents",
        unit="Hz", minimum=10, maximum=100,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check(self)
        if not isinstance(self.swarm, Mapping):
            raise ConfigError("swarm", self.swarm, "names with values")
        if "agents" in self.swarm:
            raise ConfigError("swarm.agents", self.swarm["agents"], "nothing: the robots of the file are the agents")

    @property
    def enabled(self) -> bool:
        """Whether agents on board steer the Crazyflies."""
        return bool(self.swarm)


def check_onboard_swarm(swarm: SwarmConfig) -> None:
    """Check that the app can fly a swarm; ConfigError: it cannot."""
    if swarm.agents > MAX_AGENTS:
        raise ConfigError("agents", swarm.agents, f"1 to {MAX_AGENTS} on board")
    for name, known in (("policy", POLICIES), ("estimator", ESTIMATORS)):
        if getattr(swarm, name) not in known:
            raise ConfigError(name, getattr(swarm, name), f"{', '.join(known)} on board")
    check_fits(swarm, PORT)


def app_parameters(swarm: SwarmConfig, scenario: Scenario, height: float) -> dict[str, float]:
    """Return the app's parameters for a swarm, by `group.name`; the agent is not enabled yet.

    :param scenario: starts and goals; outside the box around them the app lands.
    :param height: m, of the frame map's origin above the floor.
    """
    values: dict[str, float] = {
        "enable": 0, "agents": swarm.agents, "policy": POLICIES.index(swarm.policy),
        "estimator": ESTIMATORS.index(swarm.estimator),
        "header": int.from_bytes(header_of(swarm, PORT) or b"\0\0", "little"), "steps": swarm.steps,
        # With a policy that no agent can join later, all agents begin together in this slot.
        "beginSlot": 0 if swarm.policy_row.may_join else 4 * swarm.turn_every * swarm.agents,
        "goalsKnown": swarm.targets_known,
        "slotUs": swarm.slot_ns // 1000, "flightUs": FLIGHT_US, "seed": swarm.seed, "height": height,
    }  # fmt: skip
    places = np.concatenate((scenario.start, scenario.target), axis=1) + np.array([[0.0], [0.0], [height]])
    low, high = places.min(axis=1) - _MARGIN_M, places.max(axis=1) + _MARGIN_M
    for axis, least, most in zip("XYZ", low.tolist(), high.tolist(), strict=True):
        values |= {f"low{axis}": least, f"high{axis}": most}
    return {f"dtsa.{name}": value for name, value in values.items()}


def key_of(swarm: SwarmConfig) -> bytes:
    """Return the environment's key of signed frames, or nothing; ConfigError: not 16 bytes, or no session."""
    check_session(swarm)
    signing = authenticator(swarm)
    key = b"" if signing is None else signing.key_and_session[0]
    if signing is not None and len(key) != KEY_BYTES:
        raise ConfigError(VARIABLE, f"{len(key)} bytes", f"{KEY_BYTES} bytes on board")
    return key


def app_orders(swarm: SwarmConfig, scenario: Scenario, key: bytes = b"") -> list[bytes]:
    """Return the orders that set up the app: random key of the policy, all starts and goals, signing key (16 bytes)."""
    packets = [b"D" + struct.pack("<Q", policy_key(swarm.seed))]
    for letter, places in ((b"F", scenario.start), (b"T", scenario.target)):
        for k in range(swarm.agents):
            packets.append(letter + struct.pack("<B3d", k + 1, *(float(places[i, k]) for i in range(3))))
    if swarm.auth:
        packets.append(b"K" + key + struct.pack("<Q", swarm.auth_session))
    return packets


@dataclass(frozen=True, slots=True)
class OnboardSetup:
    """Set-up of one Crazyflie's app on the ground."""

    parameters: Mapping[str, float]  # of the app, by `group.name`
    orders: Sequence[bytes]  # packets of the app channel, sent in this order
    polls_hz: float  # Hz, how often the Crazyflie is polled once its agent has started

    def prepare(self, cf: Any) -> None:
        """Send parameters and orders to the app; LinkError: the Crazyflie has no such app, or the app refuses."""
        unconfirmed, all_confirmed = set(self.parameters), threading.Event()

        def confirm(name: str, value: str) -> None:
            unconfirmed.discard(name)
            if not unconfirmed:
                all_confirmed.set()

        for name, value in self.parameters.items():
            cf.param.add_update_callback(*name.split("."), cb=confirm)
            try:
                cf.param.set_value(name, value)
            except (KeyError, AttributeError) as error:
                raise LinkError(f"parameter {name} of the app on board: {error}") from error
        if not all_confirmed.wait(_CONFIRM_TIMEOUT_S):
            raise LinkError(f"not confirmed: {', '.join(sorted(unconfirmed))}")
        for name in self.parameters:
            cf.param.remove_update_callback(*name.split("."), cb=confirm)
        for order in self.orders:
            send_order(cf, order)


def send_order(cf: Any, order: bytes) -> None:
    """Send an order to the app on board, and wait for its answer; LinkError: no answer, or the app refuses."""
    answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def receive(data: Any) -> None:
        if bytes(data)[:1] == order[:1]:
            answers.put(bytes(data))

    cf.appchannel.packet_received.add_callback(receive)
    try:
        for _ in range(_ATTEMPTS):
            cf.appchannel.send_packet(order)
            with suppress(queue.Empty):
                answer = answers.get(timeout=_ANSWER_TIMEOUT_S)
                break
        else:
            raise LinkError(f"the app on board does not answer order {order[:1].decode()}")
    finally:
        cf.appchannel.packet_received.remove_callback(receive)
    if answer[1:2] != b"\x01":
        why = answer[2:].decode(errors="replace")
        raise LinkError(f"the app on board refuses order {order[:1].decode()}: {why}")
