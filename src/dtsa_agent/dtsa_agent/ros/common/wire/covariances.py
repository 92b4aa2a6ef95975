"""Covariances of odometry: what is known is given with its precision, what is not modelled is not claimed.

Row-major 6 x 6 over (x, y, z, rotation about x, y, z), in m^2 and rad^2, (m/s)^2 and (rad/s)^2. Zeros would say
that a value is exact.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

PRECISION = 1e-6  # m^2 or (m/s)^2: a millimetre, a millimetre per second
UNKNOWN = 1e6  # nothing is known about this value


def diagonal(linear: float, angular: float) -> NDArray[np.float64]:
    """A covariance without correlations, (36,).

    :param linear: variance of each of the first three values, m^2 or (m/s)^2.
    :param angular: variance of each of the last three values, rad^2 or (rad/s)^2.
    """
    return np.diag([linear] * 3 + [angular] * 3).ravel()


POSE_COVARIANCE = diagonal(PRECISION, UNKNOWN)  # of simulated bodies: the attitude is not modelled
TWIST_COVARIANCE = diagonal(PRECISION, UNKNOWN)
