"""Named flight models: how an agent avoids the others, how its vehicle answers, what room a swarm needs.

Formulas and the reasons for the values: ``docs/reference/avoiders.md``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.binding import AVOID
from dtsa_agent.core.compiled import MISSING
from dtsa_agent.core.compiled import kernel as _kernel
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.reference.arithmetic import Vector
from dtsa_agent.core.registry import Registry, check_kernel

from .declaration import REQUIRED, Settings, check, setting, settings_of

Array = NDArray[np.float64]

# Numbers of the avoiders in libdtsa (dtsa.h).
KINDS = ("orca", "potential", "bvc", "none")
check_kernel("avoiders", KINDS)


@dataclass(frozen=True, slots=True)
class AvoiderParams(Settings):
    """Parameters of the avoiders; which of them count depends on the avoider.

    :raises ConfigError: for values outside their range.
    """

    v_max: float = setting(1.5, "largest commanded speed", unit="m/s", minimum=0.01, maximum=20)
    gain: float = setting(2.0, "K_P: speed towards the goal per distance to it", unit="1/s", minimum=0.01, maximum=100)
    radius: float = setting(0.336, "orca: R_c, of a pair; bvc: of one agent", unit="m", minimum=0.01, maximum=10)
    horizon: float = setting(
        1.0, "orca: T, look-ahead; bvc: the cell ends at horizon * v_max", unit="s", minimum=0.05, maximum=60
    )
    softness: float = setting(30.0, "orca: rho, weight of a violated half-plane", unit="1", minimum=0.01, maximum=1e6)
    bias: float = setting(0.2, "orca: beta, share by which all keep to the right", unit="1", minimum=-1, maximum=1)
    period: float = setting(0.2, "orca: T_s, time in which an overlap is resolved", unit="s", minimum=0.001, maximum=10)
    influence: float = setting(1.31, "potential: r_inf, range of the field", unit="m", minimum=0.03, maximum=100)
    strength: float = setting(0.33, "potential: k, strength of the field", unit="m^2/s", minimum=0, maximum=100)
    core: float = setting(0.1, "potential: d_c, distance of infinite repulsion", unit="m", minimum=0, maximum=100)
    tangential: float = setting(
        0.3, "potential: c_t, share of the force that acts sideways", unit="1", minimum=-2, maximum=2
    )
    margin_rate: float = setting(0.0, "growth of a safety margin with age", unit="m/s", minimum=0, maximum=10)
    margin_max: float = setting(0.3, "largest such margin", unit="m", minimum=0, maximum=10)
    sidestep: float = setting(
        0.25, "bvc: closer to the wall than this, step to the right", unit="m", minimum=1e-6, maximum=10
    )
    stretch_z: float = setting(
        1.0, "bvc: height of an agent over its width (downwash)", unit="1", minimum=0.1, maximum=20
    )

    def __post_init__(self) -> None:
        check(self)
        if self.core >= self.influence:
            raise ConfigError("core", self.core, f"less than influence, {self.influence:g} m")


@dataclass(frozen=True, slots=True)
class VehicleParams(Settings):
    """Point mass that follows a velocity command: a = clip((v_cmd - v) / tau, a_max).

    :raises ConfigError: for values outside their range.
    """

    tau: float = setting(0.25, "time constant of the velocity response", unit="s", minimum=0.01, maximum=10)
    a_max: float = setting(2.0, "largest acceleration (norm)", unit="m/s^2", minimum=0.01, maximum=200)

    def step(self, dt: float, position: Array, velocity: Array, command: Array) -> None:
        """Moves vehicles on by one step; ``position`` and ``velocity`` are updated in place.

        :param dt: step, s; not longer than ``tau``.
        :param position: (3,) or (3, N), m, frame map.
        :param velocity: same shape, m/s.
        :param command: commanded velocity, same shape, m/s.
        """
        if not MISSING:
            states = (np.asarray(array, dtype=np.float64).tobytes() for array in (position, velocity, command))
            both = np.frombuffer(_kernel.vehicle_step(self.tau, self.a_max, dt, *states))
            position[...], velocity[...] = both.reshape(2, *position.shape)
            return
        from dtsa_agent.core.reference import vehicle  # nodes start without it

        p, v, c = (np.atleast_2d(array.T) for array in (position, velocity, command))
        moved = [vehicle.step(self.tau, self.a_max, dt, *map(_vector, now)) for now in zip(p, v, c, strict=True)]
        p[:], v[:] = [place for place, _ in moved], [speed for _, speed in moved]


@dataclass(frozen=True, slots=True)
class FlightModel(Settings):
    """An avoider with its parameters, a vehicle, and the room an exchange of places needs.

    :raises ConfigError: for an unknown avoider or values outside their range.
    """

    name: str = setting(REQUIRED, "what the setting avoider calls it")
    avoider_kind: str = setting(REQUIRED, "the avoider in the compiled kernel", choices=KINDS)
    avoider: AvoiderParams = setting(REQUIRED, "the avoider's parameters", section=AvoiderParams)
    vehicle: VehicleParams = setting(REQUIRED, "the vehicle's parameters", section=VehicleParams)
    spacing: float = setting(
        REQUIRED, "s: agents on the start circle are this far apart", unit="m", minimum=1e-6, maximum=1000
    )
    min_radius: float = setting(
        REQUIRED, "r0: smallest start circle; R = max(r0, s N / 2 pi)", unit="m", minimum=1e-6, maximum=1000
    )

    @property
    def kind(self) -> int:
        """The avoider's number in the compiled kernel."""
        return KINDS.index(self.avoider_kind)

    def command(
        self,
        self_index: int,
        position: Array,
        velocity: Array,
        goal: Array,
        others_position: Array,
        others_velocity: Array,
        age_s: Array | None = None,
        *,
        plain: bool = False,
    ) -> Array:
        """Commanded velocity of one agent, (3,), m/s, frame map.

        :param self_index: the agent's place in the arrays of the others (its id - 1); that entry is ignored.
        :param position: own true position, (3,), m, frame map.
        :param velocity: own true velocity, (3,), m/s.
        :param goal: where it wants to go, (3,), m.
        :param others_position: where it believes all agents to be, (3, N), m; what is not finite is ignored.
        :param others_velocity: their velocities, (3, N), m/s.
        :param age_s: age of each one's state, (N,), s; None: no margins.
        :param plain: the avoider of the specification, not the compiled one.
        """
        if plain or MISSING:
            return self._plain_command(self_index, position, velocity, goal, others_position, others_velocity, age_s)
        given = (position, velocity, goal, others_position, others_velocity)
        p, v, target, others_p, others_v = (np.asarray(array, dtype=np.float64).tobytes() for array in given)
        ages = None if age_s is None else np.asarray(age_s, dtype=np.float64).tobytes()
        params = AVOID.image(self.avoider.to_dict())
        found = _kernel.avoid_command(self.kind, params, self_index, p, v, target, others_p, others_v, ages)
        command: Array = np.frombuffer(found).copy()
        return command

    def _plain_command(
        self,
        own: int,
        position: Array,
        velocity: Array,
        goal: Array,
        others_p: Array,
        others_v: Array,
        age: Array | None,
    ) -> Array:
        from dtsa_agent.core.reference import avoiders

        count = others_p.shape[1]
        ages = [0.0] * count if age is None else age.tolist()
        near = [
            avoiders.Neighbour(k + 1, _vector(others_p[:, k]), _vector(others_v[:, k]), ages[k])
            for k in range(count)
            if k != own
        ]
        scene = avoiders.Scene(own + 1, _vector(position), _vector(velocity), _vector(goal), near)
        return np.array(avoiders.command(self.avoider_kind, scene, avoiders.Avoidance(**self.avoider.to_dict())))


def _vector(values: Array) -> Vector:
    x, y, z = (float(value) for value in values)
    return (x, y, z)


_ORCA = AvoiderParams(v_max=1.5, radius=0.336, horizon=1.0, softness=30.0, bias=0.2)
# Vehicles that know themselves to a few centimetres only, and cannot wait for each other.
_CRAZYFLIE = dataclasses.replace(_ORCA, radius=0.40)
_POTENTIAL = AvoiderParams(v_max=1.0, influence=1.31, strength=0.33, core=0.1, tangential=0.3)
_JERKY = AvoiderParams(v_max=1.0, influence=0.43, strength=0.541, core=0.2, tangential=0.3)
_BVC = AvoiderParams(v_max=1.5, radius=0.163, horizon=1.0, sidestep=0.25)
_BVC_FIRMWARE = AvoiderParams(v_max=0.5, radius=0.3, horizon=1.0, sidestep=0.25, stretch_z=3.0)

_MODELS = (
    FlightModel("orca", "orca", _ORCA, VehicleParams(0.25, 2.0), 0.9, 2.2),
    FlightModel("crazyflie", "orca", _CRAZYFLIE, VehicleParams(0.25, 2.0), 0.9, 2.2),
    FlightModel("potential", "potential", _POTENTIAL, VehicleParams(0.1, 2.0), 0.55, 1.8),
    FlightModel("jerky", "potential", _JERKY, VehicleParams(0.05, 15.0), 0.55, 1.8),
    FlightModel("bvc", "bvc", _BVC, VehicleParams(0.25, 2.0), 0.9, 2.2),
    FlightModel("bvc-firmware", "bvc", _BVC_FIRMWARE, VehicleParams(0.25, 2.0), 0.9, 2.2),
    FlightModel("none", "none", AvoiderParams(v_max=1.5), VehicleParams(0.25, 2.0), 0.9, 2.2),
)


def _avoider_plug_in(name: str, factory: Any) -> FlightModel:
    """The flight model of an avoider plug-in: vehicle and spacing of the built-in model that it names."""
    base = getattr(factory, "model", "orca")
    if not isinstance(base, str) or base not in AVOIDERS.rows:
        raise ConfigError(f"{name}.model", base, ", ".join(AVOIDERS.names))
    model = AVOIDERS.rows[base]
    return FlightModel(name, "none", model.avoider, model.vehicle, model.spacing, model.min_radius)


AVOIDERS = Registry("avoider", "dtsa.avoiders", _MODELS, _avoider_plug_in)
FLIGHT_MODELS: Mapping[str, FlightModel] = AVOIDERS.rows


def flight_model(name: str, options: Mapping[str, float] | None = None) -> FlightModel:
    """A named flight model, possibly with some values replaced.

    :param name: a name of :data:`AVOIDERS`, or of an avoider plug-in.
    :param options: values by the names of the fields of :class:`AvoiderParams` and :class:`VehicleParams`, or
        ``spacing`` and ``min_radius``.
        Names with a dot belong to plug-ins and are not looked at.
    :raises ConfigError: for unknown names and values outside their range.
    """
    model = AVOIDERS.row(name)
    groups: dict[str, dict[str, Any]] = {"avoider": {}, "vehicle": {}, "room": {}}
    owners = {spec.name: "avoider" for spec in settings_of(AvoiderParams)}
    owners |= {spec.name: "vehicle" for spec in settings_of(VehicleParams)}
    owners |= {"spacing": "room", "min_radius": "room"}
    for key, value in (options or {}).items():
        if "." in key:  # a plug-in's own
            continue
        if key not in owners:
            raise ConfigError(f"options.{key}", value, "one of the values " + ", ".join(owners))
        groups[owners[key]][key] = value
    return dataclasses.replace(
        model,
        avoider=dataclasses.replace(model.avoider, **groups["avoider"]),
        vehicle=dataclasses.replace(model.vehicle, **groups["vehicle"]),
        **groups["room"],
    )
