"""Motion of rendered pictures while their brightness changes."""

import numpy as np
import pytest
from fake_autopilot import S
from flown import SMALL, Flown

from orthonav.onboard.motion import PictureOdometry

COUNT, RATE_HZ = 25, 6.0


def motions(change):
    flown, odometry = Flown(20, seed=1), PictureOdometry()
    rng = np.random.default_rng(0)
    found = []
    for number in range(COUNT):
        at_s = 5 + number / RATE_HZ
        grey = 0.3 * flown.picture(at_s, SMALL) + 80  # weak contrast
        levels = np.clip(change(grey, number, rng), 0, 255).astype(np.uint8)
        found.append(odometry.motion(levels, SMALL, round(at_s * S)))
    return found[1:]


def exposed(grey, number, rng):
    return grey * rng.normal(1.0, 0.08)


def shadowed(grey, number, rng):
    columns = np.arange(grey.shape[1])
    return grey * np.where(columns < 6 * number, 0.6, 1.0)


@pytest.mark.parametrize("change", [exposed, shadowed])
def test_light_does_not_move(change):
    steady, changed = motions(lambda grey, number, rng: grey), motions(change)
    assert sum(each is not None for each in changed) >= 0.95 * len(changed)
    pairs = [(a, b) for a, b in zip(steady, changed, strict=True) if a and b]
    assert max(abs(a.turn_rad - b.turn_rad) for a, b in pairs) < 0.006
    assert max(np.hypot(*(a.shift - b.shift)) for a, b in pairs) < 0.008
