"""Where to fly: collision avoidance for one agent, as docs/reference/avoiders.md has it, in clear geometry.

The compiled avoiders compute the same in another order; they agree to about 1e-12 m/s, not bit for bit: every agent
commands itself only, so nobody else has to compute the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from .arithmetic import ZERO, Vector, dot, minus, norm, scaled
from .soft_problem import HalfSpace, cross, minimise

PARALLEL = 1e-12  # m/s, w shorter than this has no direction
STIFFNESS = 1e6  # bvc: violates a wall by (pull in m) / STIFFNESS
TOLERANCE = 1e-4  # m, bvc: a wall violated by more than this: the cell is empty


@dataclass(frozen=True, slots=True)
class Avoidance:
    """Parameters of all avoiders; which of them count depends on the avoider."""

    v_max: float  # m/s, largest commanded speed
    gain: float  # K_P, 1/s
    radius: float  # R_c of a pair (orca), R of one agent (bvc), m
    horizon: float  # T, s
    softness: float  # rho
    bias: float  # beta
    period: float  # T_s, s, in which an overlap is resolved
    influence: float  # r_inf, m
    strength: float  # k, m^2/s
    core: float  # d_c, m
    tangential: float  # c_t
    margin_rate: float  # m/s
    margin_max: float  # m
    sidestep: float  # m
    stretch_z: float

    def margin(self, age_s: float) -> float:
        """Extra distance to a neighbour whose state is some seconds old, m.

        :param age_s: s, how old the state is.
        """
        return max(0.0, min(self.margin_max, self.margin_rate * age_s))


@dataclass(frozen=True, slots=True)
class Neighbour:
    """What the agent believes of another one."""

    id: int
    position: Vector  # m
    velocity: Vector  # m/s
    age_s: float = 0.0  # s, age of the state that this comes from; counts where margins do


@dataclass(frozen=True, slots=True)
class Scene:
    """Everything that an avoider looks at."""

    id: int  # the agent's own
    position: Vector  # m, own true state
    velocity: Vector  # m/s
    goal: Vector  # m
    neighbours: Sequence[Neighbour]


def command(avoider: str, scene: Scene, params: Avoidance) -> Vector:
    """Commanded velocity, m/s.

    :param avoider: ``orca``, ``potential``, ``bvc`` or ``none``.
    :param scene: the agent and its neighbours; whoever is nowhere (not a number) is ignored.
    :param params: the avoider's parameters.
    """
    return limited(AVOIDERS[avoider](scene, params), params.v_max)


def limited(v: Vector, v_max: float) -> Vector:
    """A velocity shortened to v_max.

    :param v: (3,) m/s.
    """
    return scaled(v_max / norm(v), v) if dot(v, v) > v_max * v_max * (1.0 + 1e-12) else v


def preferred(scene: Scene, params: Avoidance) -> Vector:
    """v_pref = min(v_max, K_P d) towards the goal, d = distance to it."""
    return limited(scaled(params.gain, minus(scene.goal, scene.position)), params.v_max)


# --- orca: reciprocal avoidance, soft ---------------------------------------------------------------------------


def orca(scene: Scene, params: Avoidance) -> Vector:
    """The velocity nearest to v_pref, turned a little to the right, outside of what would collide within T."""
    x, y, z = preferred(scene, params)
    wish = limited((x + params.bias * y, y - params.bias * x, z), params.v_max)
    reach = params.radius + 2.0 * params.v_max * params.horizon
    spaces = [
        orca_half_space(scene, other, params)
        for other in scene.neighbours
        if norm(minus(other.position, scene.position)) < reach + params.margin(other.age_s)
    ]
    return minimise(wish, spaces, params.softness)


def orca_half_space(scene: Scene, other: Neighbour, params: Avoidance) -> HalfSpace:
    """Velocities with which an agent does its half of avoiding another one for T seconds (RVO2-3D).

    Relative velocities w0 that collide form a cone with a round end, the velocity obstacle. w = w0 - q r leads from its
    nearest axis point out of it, kappa = R_c q - |w| is how far; q is 1 / T_s in an overlap, 1 / T at the round end.
    """
    r, w0 = minus(other.position, scene.position), minus(scene.velocity, other.velocity)
    radius = params.radius + params.margin(other.age_s)
    e = minus(w0, scaled(1.0 / params.horizon, r))
    if dot(r, r) <= radius * radius:
        q = 1.0 / params.period
    elif dot(e, r) < 0.0 and dot(e, r) ** 2 > radius * radius * dot(e, e):
        q = 1.0 / params.horizon
    else:  # the cone's side
        q = (dot(r, w0) + radius * norm(cross(r, w0)) / math.sqrt(dot(r, r) - radius * radius)) / dot(r, r)
    w = minus(w0, scaled(q, r))
    normal = scaled(1.0 / norm(w), w) if norm(w) > PARALLEL else apart(scene, other, r)
    kappa = radius * q - norm(w)
    return HalfSpace(normal, dot(normal, scene.velocity) + 0.5 * kappa)


def apart(scene: Scene, other: Neighbour, r: Vector) -> Vector:
    """There is no nearest way out: straight away from the other one; from one point, along x in the order of ids.

    :param r: (3,) m, to the other one.
    """
    distance = norm(r)
    if distance > 0.0:
        return scaled(-1.0 / distance, r)
    return (-1.0 if other.id > scene.id else 1.0, 0.0, 0.0)


# --- potential: a repulsive field -------------------------------------------------------------------------------


def potential(scene: Scene, params: Avoidance) -> Vector:
    """v_pref + sum over d < r_inf of f (e + c_t z x e), with e = (p - p_j) / d."""
    total = preferred(scene, params)
    for other in scene.neighbours:
        r = minus(scene.position, other.position)
        distance, margin = norm(r), params.margin(other.age_s)
        reach, core = params.influence + margin, params.core + margin
        if not distance < reach:
            continue
        e = scaled(1.0 / max(distance, 1e-12), r)
        f = params.strength * (1.0 / max(distance - core, 0.02) - 1.0 / (reach - core))
        f, side = min(f, 4.0 * params.v_max), params.tangential
        total = (
            total[0] + f * (e[0] - side * e[1]),
            total[1] + f * (e[1] + side * e[0]),
            total[2] + f * e[2],
        )
    return total


# --- bvc: buffered Voronoi cells --------------------------------------------------------------------------------


def bvc(scene: Scene, params: Avoidance) -> Vector:
    """Flies to the point of the own cell that is nearest to the goal. Places are relative to the own position."""
    to_goal = minus(scene.goal, scene.position)
    walls = [*bvc_walls(scene, params), *bvc_box(params)]
    share = bvc_share(walls, to_goal)
    inside = all(wall.bound <= 0.0 for wall in walls)
    if inside and share >= 1.0:
        return scaled(params.gain, to_goal)  # a goal inside the cell is left alone
    wish, to_wall = to_goal, share * norm(to_goal)
    if to_wall <= params.sidestep:
        amount = (1.0 - to_wall / params.sidestep) ** 2
        wish = (to_goal[0] + amount * to_goal[1], to_goal[1] - amount * to_goal[0], to_goal[2])
    target = minimise(wish, walls, STIFFNESS)
    if any(wall.lack(target) > TOLERANCE for wall in walls):
        return ZERO  # the cell is empty: stay
    return scaled(params.gain, target)


def bvc_walls(scene: Scene, params: Avoidance) -> Iterator[HalfSpace]:
    """The cell's walls: half way to each neighbour, drawn in by one radius.

    In coordinates in which an agent is a ball of radius 1 (it is ``stretch_z`` times as high as wide) that is
    e.x <= d / 2 - 1, e the direction to the neighbour and d its distance.
    """
    side = params.horizon * params.v_max
    for other in scene.neighbours:
        r = minus(other.position, scene.position)
        if not dot(r, r) < math.inf:
            continue
        if r == ZERO:
            r = (1e-9 if other.id > scene.id else -1e-9, 0.0, 0.0)
        across = 1.0 / (params.radius + 0.5 * params.margin(other.age_s))
        stretch = (across, across, across / params.stretch_z)
        ball = (r[0] * stretch[0], r[1] * stretch[1], r[2] * stretch[2])
        distance = norm(ball)
        # The wall's normal in metres: the gradient of e.x.
        e = (ball[0] * stretch[0] / distance, ball[1] * stretch[1] / distance, ball[2] * stretch[2] / distance)
        wall = (0.5 * distance - 1.0) / norm(e)
        if wall <= 2.0 * side:  # not beyond the box's corners
            yield HalfSpace(scaled(-1.0 / norm(e), e), -wall)


def bvc_box(params: Avoidance) -> Iterator[HalfSpace]:
    """The cell ends at horizon v_max in x, y and z."""
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = [0.0, 0.0, 0.0]
            normal[axis] = sign
            yield HalfSpace((normal[0], normal[1], normal[2]), -params.horizon * params.v_max)


def bvc_share(walls: Sequence[HalfSpace], way: Vector) -> float:
    """How far one can go along a way before the first wall, as a share of it; at least 0."""
    nearer = [(wall.bound, dot(wall.normal, way)) for wall in walls]
    return max(0.0, min((bound / along for bound, along in nearer if along < 0.0), default=math.inf))


AVOIDERS: dict[str, Callable[[Scene, Avoidance], Vector]] = {
    "orca": orca,
    "potential": potential,
    "bvc": bvc,
    "none": preferred,
}
