"""Tilt of the camera that the telemetry does not report.

The mount leans by a constant angle, and the horizon of the autopilot, which it flies level by, errs
by an angle that changes slowly.
"""

import numpy as np
from numpy.typing import NDArray

from orthonav.ground.simulate.motion import gauss_markov, mounted

HORIZON_TIME_S = 15.0
"""Correlation time of the horizon. Errors of real autopilots change within 10 to 30 s."""
Array = NDArray[np.float64]


def horizon_errors(std_deg: float, times_s: Array, rng: np.random.Generator) -> Array:
    """True minus reported pitch and roll (N, 2) along a route, deg, at evenly spaced times (N,).

    A first-order Gauss-Markov process of this standard deviation.
    """
    step_s = float(times_s[1] - times_s[0]) if len(times_s) > 1 else 1.0
    return std_deg * gauss_markov(step_s / HORIZON_TIME_S, len(times_s), rng)


def camera_attitude(
    reported_deg: tuple[float, float, float], horizon_deg: Array, mount_deg: Array
) -> tuple[float, float, float]:
    """Heading, pitch and roll of a camera whose aircraft is tilted by `horizon_deg` (2,) more than
    reported, in a mount that leans by `mount_deg` (2,)."""
    yaw_deg, pitch_deg, roll_deg = reported_deg
    pitch_off, roll_off = horizon_deg.tolist()
    aircraft = yaw_deg, pitch_deg + pitch_off, roll_deg + roll_off
    pitch_mount, roll_mount = mount_deg.tolist()
    return mounted(aircraft, pitch_mount, roll_mount) if pitch_mount or roll_mount else aircraft
