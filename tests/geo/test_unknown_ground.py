"""What ground of unknown slope costs."""

import math

import pytest

from orthonav.cli.common import OPTIONS
from orthonav.core.geo.ground import RELIEF_SLOPES, unknown_slope_share


def test_slope_and_tilt_are_told_apart_by_what_is_known_of_each():
    assert unknown_slope_share(0) == 0
    assert unknown_slope_share(90, "rolling") == pytest.approx(0.05 / math.sqrt(2), rel=1e-3)
    for relief, slope in RELIEF_SLOPES.items():
        tilt = math.radians(1)
        exact = 1 / math.sqrt(1 / tilt**2 + 2 / slope**2)
        assert unknown_slope_share(1, relief) == pytest.approx(exact)


def test_the_command_line_offers_all_reliefs():
    assert OPTIONS["--relief"]["choices"] == tuple(RELIEF_SLOPES)
