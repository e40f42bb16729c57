"""Clouds: as many as asked, closed in the middle, soft at the edges, moving with the ground."""

import numpy as np
import pytest

from orthonav.core.geo.camera import Camera
from orthonav.ground.simulate.render import GRID, HEIGHT, Clouds

CAMERA = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)
AGL_M = 1000.0
LEVEL = (0.0, 0.0, 0.0, AGL_M)


def degrees_of(count, share, seed=0):
    clouds = Clouds(count, share, seed)
    return np.array([clouds.degree(number) for number in range(count)])


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2, 0.77, 1.0])
@pytest.mark.parametrize("count", [1, 7, 500])
def test_the_share_of_views_with_clouds(count, share):
    degree = degrees_of(count, share)
    assert (degree > 0).sum() == round(share * count)
    assert degree.min() >= 0 and degree.max() <= 1


@pytest.fixture(scope="module")
def clouds():
    return Clouds(60, 1.0, 5)


def test_cover_grows_with_the_degree(clouds):
    found = []
    for number in range(60):
        cover = clouds.before(number, CAMERA, LEVEL, np.zeros(2))
        assert cover.opacity.shape == (240, 320) == cover.grey.shape
        assert cover.opacity.min() >= 0 and cover.opacity.max() <= 1
        found.append((clouds.degree(number), float(cover.opacity.mean())))
    degree, hidden = np.array(sorted(found)).T
    assert np.corrcoef(degree, hidden)[0, 1] > 0.9
    assert (hidden[degree == 1] == 1).all() and hidden[degree < 0.2].max() < 0.6


def test_clouds_pass_below_the_aircraft(clouds):
    """Half as high as the aircraft, they move twice as fast through the view as the ground."""
    number = min(range(60), key=lambda n: abs(clouds.degree(n) - 0.5))
    rows = 4 * GRID
    north_m = rows * CAMERA.gsd_m(AGL_M * (1 - HEIGHT))
    before = clouds.before(number, CAMERA, LEVEL, np.zeros(2)).opacity
    after = clouds.before(number, CAMERA, LEVEL, np.array([0.0, north_m])).opacity
    same = np.corrcoef(after[rows:].ravel(), before[:-rows].ravel())[0, 1]
    assert same > 0.97
    assert np.corrcoef(after.ravel(), before.ravel())[0, 1] < 0.9
