"""The protocol on board, in the laboratory: what the ground does, and a bag of each agent's flight."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import dtsa_agent
from dtsa_agent.air.record import ReceivedFrame, SlotRecord, SlotRecords
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie.onboard import KEY_BYTES, PORT, START, app_orders, app_parameters, check_onboard_swarm
from dtsa_bench.log.agent_bag import AgentRecorder

from .app import App, LabSettings, read_app
from .laboratory import Laboratory

APP = Path(dtsa_agent.__file__).parent / "onboard"
_OPENED, _HEARD = struct.Struct("<3B2q2HI13d"), struct.Struct("<4B2q60s")  # onboard/watch.c
_ORDER_S = 0.02  # from one packet of the app channel to the next
_CLIMB_S = 3.0
HEIGHT_M = 1.2  # of the frame map above the floor
_UP = np.array([[0.0], [0.0], [HEIGHT_M]])


class _PeerPort:
    """The port of a Crazyflie, for the bag."""

    properties, where = PORT, "peer to peer"

    def to_dict(self) -> dict[str, Any]:
        """No settings."""
        return {}


class _AgentFlight:
    """What one agent has noted, and its bag."""

    def __init__(self, agent: int, config: SwarmConfig, path: Path) -> None:
        # The vehicle's clock begins when it is switched on.
        self._recorder = AgentRecorder(path, AgentSettings(id=agent), config, _PeerPort(), not config.targets_known, 0)
        self._records = SlotRecords(self._recorder)
        self._steps = config.steps

    def note(self, data: bytes) -> None:
        """Receive what the app has noted."""
        if data[:1] == b"O":
            self._open(data)
            return
        kind, accepted, sender, length, slot, at_ns, frame = _HEARD.unpack(data)
        if kind == ord("S"):
            self._records.transmit(at_ns, frame[:length])
        elif kind == ord("A"):
            self._records.restart()
        else:
            self._records.receive(ReceivedFrame(sender, slot, at_ns, frame[:length], bool(accepted)))

    def _open(self, data: bytes) -> None:
        _, is_first, reason, slot, start, present, chosen, digest, score, *vectors = _OPENED.unpack(data)
        position, velocity, command, goal = np.array(vectors).reshape(4, 3)
        track = np.repeat(position[None], self._steps, axis=0)
        self._records.open(SlotRecord(
            slot, start, bool(is_first), present, chosen, reason, digest, score, track, velocity, command, goal
        ))  # fmt: skip

    def finish(self) -> None:
        """The flight is over."""
        self._records.close()
        self._recorder.finish({"ended": True})
        self._recorder.__exit__()


class OnboardSwarm:
    """A swarm that flies the protocol on board, and its ground.

    :param swarm: what all agents share; the app has the defaults of the rest.
    :param out: directory for bags; None: none are made.
    :param key: 16 bytes, of sealed frames.
    :param enable_s: s, when the agents may steer; None: the ground is not played here.
    :param app: the protocol's, with flags of its own; None: as it is.
    :raises ConfigError: for a swarm that the app cannot be.
    """

    def __init__(
        self, swarm: SwarmConfig, lab: LabSettings, out: Path | None = None, key: bytes = b"",
        enable_s: float | None = 8.0, app: App | None = None, make: Callable[..., Laboratory] = Laboratory,
    ) -> None:  # fmt: skip
        check_onboard_swarm(swarm)
        if swarm.auth and len(key) != KEY_BYTES:
            raise ConfigError("key", len(key) or "none", f"{KEY_BYTES} bytes on board")
        self.swarm, self.scenario = swarm, make_scenario(swarm)
        start = np.array(self.scenario.start)
        start[2] = 0.0  # on the floor
        settings = dataclasses.replace(lab, agents=swarm.agents, start=start)
        self.lab = make(app or read_app(APP), settings, out, [self.observe])
        ids = range(1, swarm.agents + 1)
        self._flights = [] if out is None else [_AgentFlight(k, swarm, out / f"cf{k}.mcap") for k in ids]
        self._key = key
        if enable_s is None:
            return
        for agent in ids:
            self.lab.at(settings.boot_s + 0.1, lambda agent=agent: self.prepare(agent))  # type: ignore[misc]
            self._climb(agent, HEIGHT_M + float(self.scenario.start[2, agent - 1]), enable_s)

    def _at(self, time_s: float, action: Callable[..., object], *given: Any) -> None:
        self.lab.at(time_s, lambda: action(*given) and None)

    def _climb(self, agent: int, height: float, enable_s: float) -> None:
        self._at(enable_s - _CLIMB_S - 0.5, self.lab.take_off, agent, height, _CLIMB_S)
        self._at(enable_s, self.lab.set_parameter, agent, "dtsa.enable", 1)

    def prepare(self, agent: int) -> None:
        """Send an agent that has just been switched on its settings and all places, and start it."""
        lab, now = self.lab, self.lab.time
        for name, value in app_parameters(self.swarm, self.scenario, HEIGHT_M).items():
            lab.set_parameter(agent, name, value)
        for i, order in enumerate([*app_orders(self.swarm, self.scenario, self._key), START]):
            self._at(now + 0.1 + i * _ORDER_S, lab.send, agent, order)

    def come_back(self, agent: int, after_s: float) -> None:
        """Switch one on that was off; it gets its settings and takes off, and may steer so many s from now on."""
        self.lab.switch_on(agent)
        self._at(self.lab.time + 0.5, self.prepare, agent)
        self._climb(agent, HEIGHT_M, self.lab.time + after_s)

    def send_goal(self, agent: int, goal: Any) -> None:
        """An agent's new goal, (3,) m, frame map, of which the others hear nothing."""
        self.lab.send(agent, b"T" + struct.pack("<B3d", agent, *map(float, goal)))

    def observe(self, kind: str, agent: int, now_ns: int, content: Any) -> None:
        """What an app has noted goes into its bag."""
        if kind == "record" and self._flights:
            self._flights[agent - 1].note(content)

    def __enter__(self) -> OnboardSwarm:
        return self

    def __exit__(self, *unused: object) -> None:
        for flight in self._flights:
            flight.finish()
        self.lab.close()

    def summary(self) -> dict[str, Any]:
        """What came of it."""
        goal = np.array(self.scenario.target) + _UP
        away = np.sqrt(((goal - self.lab.motion.vehicles.position) ** 2).sum(axis=0))
        return {**self.lab.summary(), "away_m": [round(float(x), 3) for x in away]}
