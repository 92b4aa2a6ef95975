"""Where to fly, as docs/reference/settings.md has it, in NumPy: what the compiled avoiders are compared with.

Every agent commands itself only, so no other agent has to compute the same bits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtsa_agent.core.settings.flight_models import AvoiderParams, FlightModel

Array = np.ndarray


@dataclass
class Case:
    """One question to an avoider."""

    index: int
    position: Array  # (3, N) m
    velocity: Array  # (3, N) m/s
    goal: Array  # (3,) m
    age: Array  # (N,) s

    @property
    def others(self) -> list[int]:
        return [k for k in range(self.age.size) if k != self.index and np.isfinite(self.position[:, k]).all()]

    def away(self, k: int) -> Array:
        return self.position[:, k] - self.position[:, self.index]


def command(model: FlightModel, case: Case, age: Array | None = None) -> Array:
    """Commanded velocity, (3,) m/s; age: of each one's state, None: no margins."""
    params = model.avoider
    margins = np.zeros(case.age.size) if age is None else np.clip(params.margin_rate * age, 0.0, params.margin_max)
    rules = {"orca": _orca, "potential": _potential, "bvc": _bvc, "none": lambda *given: preferred(*given[:2])}
    return limited(rules[model.avoider_kind](case, params, margins), params.v_max)


def limited(v: Array, v_max: float) -> Array:
    return v * min(1.0, v_max / max(np.linalg.norm(v), 1e-300))


def preferred(case: Case, params: AvoiderParams) -> Array:
    """v_pref = min(v_max, K_P d) towards the goal, d = distance to it."""
    return limited(params.gain * (case.goal - case.position[:, case.index]), params.v_max)


def minimise(wish: Array, normals: Array, bounds: Array, rho: float) -> Array:
    """The minimum of |x - wish|^2 / 2 + rho / 2 sum max(0, bound - normal.x)^2, by Newton's method."""

    def value(at: Array) -> float:
        return 0.5 * ((at - wish) ** 2).sum() + 0.5 * rho * (np.maximum(0.0, bounds - normals @ at) ** 2).sum()

    x = wish.copy()
    for _ in range(60):
        violated = bounds - normals @ x > 0.0
        n, lack = normals[violated], (bounds - normals @ x)[violated]
        step = -np.linalg.solve(np.eye(3) + rho * n.T @ n, x - wish - rho * n.T @ lack)
        share = 1.0
        while value(x + share * step) > value(x) + 1e-15 * (1.0 + value(x)) and share > 1e-12:
            share /= 2.0
        x = x + share * step
    return x


def turned_wish(case: Case, params: AvoiderParams) -> Array:
    """What ``orca`` would fly alone: v_pref, turned a little to the right."""
    x, y, z = preferred(case, params)
    return limited(np.array([x + params.bias * y, y - params.bias * x, z]), params.v_max)


def orca_half_spaces(case: Case, params: AvoiderParams, margins: Array) -> tuple[Array, Array]:
    """Normals (n, 3) and bounds (n,) of the velocities that do half of avoiding each other agent for T s (RVO2-3D).

    Relative velocities w0 that collide form a cone with a round end. w = w0 - q r leads from its nearest axis point out
    of it, kappa = R_c q - |w| is how far; q is 1 / T_s in an overlap, 1 / T at the round end.
    """
    own, normals, bounds = case.velocity[:, case.index], [np.zeros((0, 3))], [np.zeros(0)]
    for k in case.others:
        r, w0, radius = case.away(k), own - case.velocity[:, k], params.radius + margins[k]
        if np.linalg.norm(r) >= radius + 2.0 * params.v_max * params.horizon:
            continue
        e = w0 - r / params.horizon
        if r @ r <= radius**2:
            q = 1.0 / params.period
        elif e @ r < 0.0 and (e @ r) ** 2 > radius**2 * (e @ e):
            q = 1.0 / params.horizon
        else:  # the cone's side
            q = (r @ w0 + radius * np.linalg.norm(np.cross(r, w0)) / np.sqrt(r @ r - radius**2)) / (r @ r)
        w = w0 - q * r
        length = np.linalg.norm(w)
        if length > 1e-12:
            normal = w / length
        else:  # no nearest way out: straight away; from one point, along x in the order of ids
            normal = -r / np.linalg.norm(r) if r.any() else np.array([-1.0 if k > case.index else 1.0, 0.0, 0.0])
        normals.append(normal[None])
        bounds.append(np.array([normal @ own + 0.5 * (radius * q - length)]))
    return np.concatenate(normals), np.concatenate(bounds)


def _orca(case: Case, params: AvoiderParams, margins: Array) -> Array:
    return minimise(turned_wish(case, params), *orca_half_spaces(case, params, margins), params.softness)


def _potential(case: Case, params: AvoiderParams, margins: Array) -> Array:
    """v_pref + sum over d < r_inf of f (e + c_t z x e), with e = (p - p_j) / d."""
    total = preferred(case, params)
    for k in case.others:
        r = -case.away(k)
        distance, reach, core = np.linalg.norm(r), params.influence + margins[k], params.core + margins[k]
        if distance < reach:
            e = r / max(distance, 1e-12)
            f = params.strength * (1.0 / max(distance - core, 0.02) - 1.0 / (reach - core))
            aside = params.tangential * np.array([-e[1], e[0], 0.0])
            total = total + min(f, 4.0 * params.v_max) * (e + aside)
    return total


def bvc_walls(case: Case, params: AvoiderParams, margins: Array) -> tuple[Array, Array]:
    """Normals (n, 3) and bounds (n,) of the cell, relative to the own position: half way to each neighbour, drawn in by

    one radius, where an agent is a ball of radius 1 (``stretch_z`` times as high as wide); and the box around it.
    """
    side = params.horizon * params.v_max
    normals = [np.array([sign * np.eye(3)[axis]]) for axis in range(3) for sign in (-1.0, 1.0)]
    bounds = [-side] * 6
    for k in case.others:
        r = case.away(k) if case.away(k).any() else np.array([1e-9 if k > case.index else -1e-9, 0.0, 0.0])
        stretch = np.array([1.0, 1.0, 1.0 / params.stretch_z]) / (params.radius + 0.5 * margins[k])
        distance = np.linalg.norm(r * stretch)
        e = r * stretch * stretch / distance  # the wall's normal in metres
        wall = (0.5 * distance - 1.0) / np.linalg.norm(e)
        if wall <= 2.0 * side:  # not beyond the box's corners
            normals.append(-e[None] / np.linalg.norm(e))
            bounds.append(-wall)
    return np.concatenate(normals), np.array(bounds)


def _bvc(case: Case, params: AvoiderParams, margins: Array) -> Array:
    """Flies to the point of the own cell that is nearest to the goal."""
    way = case.goal - case.position[:, case.index]
    normals, bounds = bvc_walls(case, params, margins)
    along = normals @ way
    share = max(0.0, min((bounds[along < 0] / along[along < 0]).tolist(), default=np.inf))
    if (bounds <= 0.0).all() and share >= 1.0:
        return params.gain * way
    wish, to_wall = way, share * np.linalg.norm(way)
    if to_wall <= params.sidestep:
        amount = (1.0 - to_wall / params.sidestep) ** 2
        wish = way + amount * np.array([way[1], -way[0], 0.0])
    target = minimise(wish, normals, bounds, 1e6)
    return np.zeros(3) if (bounds - normals @ target > 1e-4).any() else params.gain * target
