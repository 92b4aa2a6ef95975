"""Named flight models: how an agent avoids the others, how its vehicle answers, what room a swarm needs.

Formulas and the reasons for the values: ``docs/reference/settings.md``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import SETTING_NAMES, ConfigError
from dtsa_agent.core.kernel import NAMES, ffi, lib, memory
from dtsa_agent.core.registry import Registry

from .declaration import REQUIRED, Settings, check, setting, settings_of

Array = NDArray[np.float64]

KINDS = NAMES["avoiders"]  # of libdtsa, in the order of their numbers


@dataclass(frozen=True, slots=True)
class AvoiderParams(Settings):
    """Parameters of the avoiders; which of them count depends on the avoider."""

    v_max: float = setting(1.5, "largest commanded speed", "m/s", 0.01, 20)
    gain: float = setting(2.0, "K_P: speed towards the goal per distance to it", "1/s", 0.01, 100)
    radius: float = setting(0.336, "orca: R_c, of a pair; bvc: of one agent", "m", 0.01, 10)
    horizon: float = setting(1.0, "orca: T, look-ahead; bvc: the cell ends at horizon * v_max", "s", 0.05, 60)
    softness: float = setting(30.0, "orca: rho, weight of a violated half-plane", "1", 0.01, 1e6)
    bias: float = setting(0.2, "orca: beta, share by which all keep to the right", "1", -1, 1)
    period: float = setting(0.2, "orca: T_s, time in which an overlap is resolved", "s", 0.001, 10)
    influence: float = setting(1.31, "potential: r_inf, range of the field", "m", 0.03, 100)
    strength: float = setting(0.33, "potential: k, strength of the field", "m^2/s", 0, 100)
    core: float = setting(0.1, "potential: d_c, distance of infinite repulsion", "m", 0, 100)
    tangential: float = setting(0.3, "potential: c_t, share of the force that acts sideways", "1", -2, 2)
    margin_rate: float = setting(0.0, "growth of a safety margin with age", "m/s", 0, 10)
    margin_max: float = setting(0.3, "largest such margin", "m", 0, 10)
    sidestep: float = setting(0.25, "bvc: closer to the wall than this, step to the right", "m", 1e-6, 10)
    stretch_z: float = setting(1.0, "bvc: height of an agent over its width (downwash)", "1", 0.1, 20)

    def __post_init__(self) -> None:
        check(self)
        if self.core >= self.influence:
            raise ConfigError("core", self.core, f"less than influence, {self.influence:g} m")


@dataclass(frozen=True, slots=True)
class VehicleParams(Settings):
    """Point mass that follows a velocity command: a = clip((v_cmd - v) / tau, a_max)."""

    tau: float = setting(0.25, "time constant of the velocity response", "s", 0.01, 10)
    a_max: float = setting(2.0, "largest acceleration (norm)", "m/s^2", 0.01, 200)

    def step(self, dt: float, position: Array, velocity: Array, command: Array) -> None:
        """Move vehicles, (3,) or (3, N), on by dt s, not longer than ``tau``: position and velocity in place."""
        p, v, c = (np.array(values, dtype=np.float64, order="C") for values in (position, velocity, command))
        if not p.shape == v.shape == c.shape or p.shape[0] != 3:
            raise ValueError(f"position, velocity, command: shapes {p.shape}, {v.shape} and {c.shape}")
        params = ffi.new("vehicle_params *", (self.tau, self.a_max))
        lib.vehicle_step_all(params, dt, p.size // 3, memory(p, writable=True), memory(v, writable=True), memory(c))
        position[...], velocity[...] = p, v


@dataclass(frozen=True, slots=True)
class FlightModel(Settings):
    """An avoider with its parameters, a vehicle, and the room an exchange of places needs."""

    name: str = setting(REQUIRED, "what the setting avoider calls it")
    avoider_kind: str = setting(REQUIRED, "the avoider in the compiled kernel", choices=KINDS)
    avoider: AvoiderParams = setting(REQUIRED, "the avoider's parameters", section=AvoiderParams)
    vehicle: VehicleParams = setting(REQUIRED, "the vehicle's parameters", section=VehicleParams)
    spacing: float = setting(REQUIRED, "s: agents on the start circle are this far apart", "m", 1e-6, 1000)
    min_radius: float = setting(REQUIRED, "r0: smallest start circle; R = max(r0, s N / 2 pi)", "m", 1e-6, 1000)

    @property
    def kind(self) -> int:
        """The avoider's number in the compiled kernel."""
        return KINDS.index(self.avoider_kind)


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
    """A named flight model, possibly with some values of avoider, vehicle, ``spacing`` or ``min_radius`` replaced.

    Names with a dot belong to plug-ins and are not looked at.

    :raises ConfigError: for unknown names and values outside their range.
    """
    model = AVOIDERS.row(name)
    values: dict[str, Any] = {key: value for key, value in (options or {}).items() if "." not in key}
    if not values:
        return model
    of_avoider, of_vehicle = ([spec.name for spec in settings_of(cls)] for cls in (AvoiderParams, VehicleParams))
    names = [*of_avoider, *of_vehicle, "spacing", "min_radius"]
    if unknown := next((key for key in values if key not in names), None):
        raise ConfigError(f"options.{unknown}", values[unknown], SETTING_NAMES + ", ".join(names))
    avoider = dataclasses.replace(model.avoider, **{key: values.pop(key) for key in of_avoider if key in values})
    vehicle = dataclasses.replace(model.vehicle, **{key: values.pop(key) for key in of_vehicle if key in values})
    return dataclasses.replace(model, avoider=avoider, vehicle=vehicle, **values)
