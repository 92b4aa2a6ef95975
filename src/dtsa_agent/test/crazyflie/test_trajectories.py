"""Trajectories: what can be uploaded, how it is stored, and what is refused before it starts."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from dtsa_agent.crazyflie.motion.trajectories import COMPRESSED, PLAIN, Piece, Planned, Trajectory, meeting, why_not
from dtsa_agent.crazyflie.settings.config import StationSettings
from dtsa_bench.crazyflies.simulated.trajectories import Trajectory as Flown
from dtsa_bench.crazyflies.simulated.trajectories import TrajectoryMemory

NOTHING = (0.0,) * 8
STATION = StationSettings()  # the fence, in the world: x 1.5 m, y 2.3 m to both sides, z 0 to 1.9 m


def line(x0: float, x1: float, duration: float = 2.0, z: float = 0.0) -> Piece:
    """Along x, at one speed."""
    return Piece((x0, (x1 - x0) / duration, *NOTHING[2:]), NOTHING, (z, *NOTHING[1:]), NOTHING, duration)


def waves(count: int, step: float = 0.0) -> tuple[Piece, ...]:
    """Pieces that follow each other, with a step before the second one."""
    pieces, rng, here = [], np.random.default_rng(3), (0.0, 0.0, 0.0, 0.0)
    for k in range(count):
        axes = [(value, *rng.uniform(-0.05, 0.05, 7).tolist()) for value in here]
        pieces.append(Piece(axes[0], axes[1], axes[2], axes[3], 0.9))
        here = tuple(sum(c * 0.9**i for i, c in enumerate(axis)) for axis in axes)  # type: ignore[assignment]
        here = (here[0] + (step if k == 0 else 0.0), *here[1:])
    return tuple(pieces)


@pytest.mark.parametrize(("count", "kind", "within"), [(5, PLAIN, 1e-6), (40, COMPRESSED, 0.005)])
def test_what_is_stored_leads_where_it_should(count: int, kind: int, within: float) -> None:
    trajectory = Trajectory(3, 0, waves(count, step=0.2))
    assert trajectory.kind == kind
    memory = TrajectoryMemory()
    assert memory.write(struct.pack("<BI", 0, 0) + trajectory.packed())[-1] == 0
    assert memory.define(struct.pack("<BBBIB", 3, 1, kind, 0, count)) == 0
    stored = memory.pieces(3)
    assert stored is not None
    flown = Flown(0.0, stored)
    assert flown.duration == pytest.approx(trajectory.duration)
    for k, piece in enumerate(trajectory.flown()):
        for t in (0.01, 0.3, 0.89):
            place = [sum(c * t**i for i, c in enumerate(axis)) for axis in (piece.x, piece.y, piece.z)]
            assert math.dist(flown.goal(0.9 * k + t).position, place) < within
            yaw = sum(c * t**i for i, c in enumerate(piece.yaw))
            assert flown.goal(0.9 * k + t).yaw == pytest.approx(yaw, abs=within)


def test_what_cannot_be_stored_is_refused_in_so_many_words() -> None:
    for make, words in (
        (lambda: Piece(NOTHING[:7], NOTHING, NOTHING, NOTHING, 1.0), "x has 7 coefficients, not 8"),
        (lambda: Piece(NOTHING, NOTHING, (math.nan, *NOTHING[1:]), NOTHING, 1.0), "a coefficient of z is not finite"),
        (lambda: Piece(NOTHING, NOTHING, NOTHING, NOTHING, 0.0), "a duration of 0 s"),
        (lambda: Trajectory(10, 0, waves(1)), "numbers are 0 to 9"),
        (lambda: Trajectory(0, 0, ()), "no pieces"),
        (lambda: Trajectory(0, 0, (line(0.0, 1e39),)), "too large to be stored"),
        (lambda: Trajectory(0, 30, waves(9)), "behind 3960 others; there are 4096"),
        (lambda: Trajectory(0, 0, waves(3, step=0.6)), "piece 1 begins 0.60 m from the end of the one before"),
    ):
        with pytest.raises(ValueError, match=words):
            make()
    assert Trajectory(0, 0, waves(3)).overlaps(Trajectory(1, 2, waves(3)))
    assert not Trajectory(0, 0, waves(3)).overlaps(Trajectory(1, 3, waves(3)))


def test_trajectories_that_leave_the_room_or_hurry_are_not_started() -> None:
    def start(pieces: tuple[Piece, ...], x: float, timescale: float = 1.0, **how: bool) -> str:
        how = {"reverse": False, "relative": True} | how
        return why_not(Trajectory(2, 0, pieces), (x, 0.0, 1.0), STATION, timescale, **how)

    ahead = (line(0.0, 1.0),)
    assert start(ahead, 0.4) == ""
    assert start(ahead, 0.6) == "trajectory 2: (1.60, 0.00, 0.05) is 0.10 m outside the geofence in x"
    assert start(ahead, -0.6, reverse=True) == "trajectory 2: (-1.60, 0.00, 0.05) is 0.10 m outside the geofence in x"
    assert start((line(0.0, 1.0, z=1.0),), 0.1, relative=False) == ""
    assert start((line(0.0, 1.0, z=1.0),), 0.9, relative=False, reverse=True) == ""
    away = start((line(0.0, 1.0, z=1.0),), 0.9, relative=False)
    assert away == "trajectory 2 begins at (0.00, 0.00, 1.00) in the world, 0.90 m from here: go there first"
    assert start(ahead, 0.0, 0.1) == "trajectory 2 reaches 5.00 m/s (station.max_stream_mps is 3)"
    for timescale in (0.0, -1.0, math.nan, math.inf):
        assert "a timescale of" in start(ahead, 0.0, timescale)
    assert start(waves(40), 0.0) == ""
    for how in ({"timescale": 2.0}, {"reverse": True}):
        assert "forwards and at its own pace only" in start(waves(40), 0.0, **how)  # type: ignore[arg-type]


def test_those_that_would_meet_are_named() -> None:
    east, west = Trajectory(0, 0, (line(0.0, 1.0), line(1.0, 1.0))), Trajectory(0, 0, (line(0.0, -1.0),))

    def plan(name: str, trajectory: Trajectory, x: float, y: float, timescale: float = 1.0) -> Planned:
        return Planned(name, trajectory, (x, y, 1.0), timescale, False, True)

    both = [plan("cf1", east, -0.5, 0.0), plan("cf2", west, 0.5, 0.05)]
    assert meeting(both, {}, 0.2) == "cf1 and cf2 would come within 0.05 m after 1.0 s"
    assert meeting(both, {}, 0.0) == meeting([both[0], plan("cf2", west, 0.5, 0.25)], {}, 0.2) == ""
    assert meeting([plan("cf1", east, -0.5, 0.0, 2.0)], {"cf9": (0.25, 0.0, 1.0)}, 0.2).startswith("cf1 and cf9 ")
    assert meeting([plan("cf1", east, -0.5, 0.0)], {"cf9": (0.75, 0.0, 1.0)}, 0.2) == ""
    back = Planned("cf1", east, (0.0, 0.0, 1.0), 1.0, True, False)
    assert back.places(np.array([0.0, 2.0, 3.0, 9.0]))[:, 0] == pytest.approx([1.0, 1.0, 0.5, 0.0])
    bent = Planned("cf1", Trajectory(0, 0, waves(40, step=0.2)), (0.0, 0.0, 0.0), 1.0, False, True)
    assert np.abs(np.diff(bent.places(np.linspace(0.0, 36.0, 3601)), axis=0)).max() < 0.03
