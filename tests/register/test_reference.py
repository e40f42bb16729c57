"""Windows of the map are cut from one picture of it, however they are made."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import Sheet

from helpers import textured
from orthonav.core.register import window as module
from orthonav.core.register.channels import COARSE, FINE
from orthonav.core.register.window import Reference

SHAPE = (160, 232)


class Counted(Sheet):
    """A sheet that remembers which windows were read."""

    def __init__(self, *arguments, **keywords):
        super().__init__(*arguments, **keywords)
        self.read_px = []

    def read(self, level, row, col, height, width):
        self.read_px.append(height * width)
        return super().read(level, row, col, height, width)


def sheet(holes):
    valid = np.ones(SHAPE, bool)
    if holes:
        valid[:, :48] = False
        valid[60:100, 120:180] = False
    return Counted(textured(SHAPE), valid)


@pytest.fixture(scope="module", params=[False, True], ids=["all valid", "holes"])
def holes(request):
    return request.param


@pytest.fixture(scope="module")
def whole(holes):
    """A reference all of whose levels are made ready at once."""
    return Reference(sheet(holes))


@pytest.fixture
def piecewise(holes, monkeypatch):
    """A reference that makes each window again."""
    monkeypatch.setattr(module, "WHOLE_LEVEL_PX", 0)
    return Reference(sheet(holes))


def cut(made, row, col, height, width):
    """A window of (H, W, C), zero beyond it."""
    far = 400
    padded = np.pad(made, ((far, far), (far, far), (0, 0)))
    return padded[far + row : far + row + height, far + col : far + col + width]


def test_threads_make_a_level_once(holes):
    reference = Reference(sheet(holes))
    with ThreadPoolExecutor(4) as pool:
        made = list(pool.map(lambda _: reference.whole(0), range(8)))
    assert all(each is made[0] for each in made) and len(reference.pyramid.read_px) == 1


@settings(max_examples=30, deadline=None)
@given(
    level=st.integers(0, 2),
    row=st.integers(-120, 220),
    col=st.integers(-120, 280),
    size=st.tuples(st.integers(1, 120), st.integers(1, 120)),
)
def test_any_window_is_cut_from_the_whole(whole, level, row, col, size):
    made = whole.window(level, row, col, *size)
    np.testing.assert_array_equal(made, cut(whole.whole(level), row, col, *size))


WINDOWS = {
    "inside": (40, 90, 64, 80),
    "north-west corner": (-20, -30, 70, 90),
    "south-east corner": (120, 190, 70, 90),
    "the border itself": (0, 0, 30, 232),
    "larger than the sheet": (-40, -50, 260, 330),
    "beyond the holes": (10, 20, 120, 40),
    "one pixel": (75, 118, 1, 1),
}


@pytest.mark.parametrize("recipe", [FINE, COARSE], ids=["fine", "coarse"])
@pytest.mark.parametrize("window", WINDOWS.values(), ids=WINDOWS.keys())
def test_a_window_made_alone_is_the_same(whole, piecewise, window, recipe):
    for level in range(2):
        row, col, height, width = (value >> level for value in window)
        place = row, col, max(height, 1), max(width, 1)
        expected = cut(whole.whole(level, recipe), *place)
        np.testing.assert_allclose(piecewise.window(level, *place, recipe), expected, atol=2e-3)


def test_a_window_made_alone_reads_little(piecewise):
    made = piecewise.window(0, 60, 60, 30, 40)
    assert made.shape == (30, 40, 4)
    margin = FINE.margin_px
    assert piecewise.pyramid.read_px == [(30 + 2 * margin) * (40 + 2 * margin)]
    piecewise.window(0, -1000, -1000, 3000, 3000)
    assert piecewise.pyramid.read_px[1] == SHAPE[0] * SHAPE[1]


@pytest.mark.parametrize(
    "place", [(-300, 20), (500, 20), (20, -300), (20, 500), (SHAPE[0], 0), (0, SHAPE[1])]
)
def test_windows_outside_are_empty(whole, piecewise, place):
    for reference in (whole, piecewise):
        made = reference.window(0, *place, 40, 50)
        assert made.shape == (40, 50, 4) and made.dtype == np.float32 and not made.any()
