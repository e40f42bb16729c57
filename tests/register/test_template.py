"""A view made ready: its evidence in balance, its derivatives true, its levels of one middle."""

import math

import cv2
import numpy as np
import pytest
from scenes import Ground, as_grey, reference_of, seen, templates_of

from orthonav.core.register.channels import COARSE, FINE, GROUPS
from orthonav.core.register.pose import Pose
from orthonav.core.register.search import posed_channels, posed_half_px
from orthonav.core.register.template import (
    BLOCKS,
    JUDGED_PX,
    Levels,
    Template,
    ViewTemplates,
    energy_of,
    halved,
    turn_planes,
)

SHAPE = (384, 448)
PLACE = Pose(210.0, 180.0, 0.0, 0.0)
GROUND = Ground()


@pytest.fixture(scope="module")
def reference():
    return reference_of(GROUND, SHAPE)


def alike(one, other):
    return float((one * other).sum() / math.sqrt((one**2).sum() * (other**2).sum()))


def ragged(shape=(96, 128)):
    """A valid part with a slanted border and a hole."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return (np.abs(x - shape[1] / 2) < (0.25 + 0.25 * y / shape[0]) * shape[1]) & (
        np.hypot(x - 60, y - 40) > 9
    )


@pytest.mark.parametrize("shape", [(2, 2), (6, 40), (16, 16)])
def test_a_view_that_says_nothing_is_no_crash(shape):
    for grey, valid in (
        (np.full(shape, 99, np.uint8), np.ones(shape, bool)),
        (np.zeros(shape, np.uint8), np.zeros(shape, bool)),
    ):
        template = Template.of(grey, valid, 0, FINE)
        assert np.isfinite(template.channels).all() and np.isfinite(template.jacobian).all()
        assert np.isfinite(template.hessians).all()
        assert np.isfinite(posed_channels(template, 0.3, 0.1)).all()


@pytest.mark.parametrize("turn_deg", range(-180, 180, 20))
@pytest.mark.parametrize("log_scale", [-0.1, 0.0, 0.15])
def test_a_posed_view_is_what_the_map_shows(reference, turn_deg, log_scale):
    """Evidence that is warped is close to evidence of what is warped, under any heading."""
    pose = Pose(PLACE.x_px, PLACE.y_px, math.radians(turn_deg), log_scale)
    template = templates_of(GROUND, pose).at(0)
    posed = posed_channels(template, pose.turn_rad, pose.log_scale)
    half = posed_half_px(template, log_scale)
    assert posed.shape == (3, 2 * half, 2 * half)
    row, col = int(pose.y_px) - half, int(pose.x_px) - half
    shown = np.moveaxis(reference.window(0, row, col, 2 * half, 2 * half), -1, 0)[:3]
    inside = np.abs(posed).max(axis=0) > 0
    for group, weight in zip(GROUPS, template.weights, strict=True):
        assert energy_of(posed[group]) == pytest.approx(weight**2 * math.exp(-log_scale), rel=1e-4)
        assert alike(posed[group], shown[group] * inside) > 0.93
    turned_wrongly = posed_channels(template, -pose.turn_rad, pose.log_scale)[0:2]
    if 20 < abs(turn_deg) % 180 < 160:
        assert alike(turned_wrongly, shown[0:2]) < 0.3


def turned_planes(made, turn_rad):
    planes = np.empty((made.shape[2], *made.shape[:2]), np.float32)
    turn_planes(np.ascontiguousarray(made), turn_rad, planes, np.empty_like(planes[:2]))
    return planes


@pytest.mark.parametrize("shape", [(96, 128), (61, 83)])
def test_what_blocks_add_up_to_is_the_whole(shape):
    template = templates_of(GROUND, PLACE, shape).at(0)
    blocks = template.block_hessians
    assert blocks.shape == (BLOCKS**2, 2, 4, 4)
    np.testing.assert_allclose(blocks.sum(axis=0), template.hessians, rtol=1e-4, atol=1e-5)
    assert template.block_pixels.sum() == template.pixels
    # The blocks are those of the rows and columns they say: each alone gives its own part.
    first = np.zeros(shape, np.float32)
    first[: shape[0] // BLOCKS, : shape[1] // BLOCKS] = 1
    rows = (template.jacobian[2, 1] * first).reshape(-1)
    assert blocks[0, 1, 1, 1] == pytest.approx(float(rows @ rows), rel=1e-4)


@pytest.mark.parametrize("number, size", [(0, 0.7), (1, 0.7), (2, 0.02), (3, 0.02)])
def test_derivatives_tell_how_the_view_changes_with_the_window(number, size):
    """Against views really moved, turned and scaled: directions are turned back by the pose."""

    def channels(size):
        step = np.zeros(4)
        step[number] = size
        x, y, turn, log_scale = step
        pose = Pose(PLACE.x_px + x, PLACE.y_px + y, turn, log_scale)
        made = templates_of(GROUND, pose, (96, 96)).at(0).interleaved
        return turned_planes(made, turn)

    found = (channels(size) - channels(-size)) / (2 * size)
    expected = templates_of(GROUND, PLACE, (96, 96)).at(0).jacobian[:, number]
    for group in GROUPS:
        one, other = found[group][:, 8:-8, 8:-8], expected[group][:, 8:-8, 8:-8]
        assert alike(one, other) > 0.9
        assert 0.6 < float((one * other).sum() / (one**2).sum()) < 1.1


def test_coarser_templates_show_the_same_window():
    """Halved about the same middle: a level down, the pixels cover four of the one above."""
    views = templates_of(GROUND, PLACE, (96, 128))
    for level in range(3):
        template = views.at(level)
        assert template.level == level and template.mask.shape == (96 >> level, 128 >> level)
    assert views.at(1) is views.at(1) and views.at(1, COARSE) is not views.at(1)
    assert views.at(1, COARSE).recipe == COARSE
    fours = as_grey(seen(GROUND, PLACE, (96, 128))).reshape(48, 2, 64, 2).mean(axis=(1, 3))
    expected = Template.of(np.rint(fours).astype(np.uint8), np.ones((48, 64), bool), 1, FINE)
    np.testing.assert_allclose(views.at(1).channels, expected.channels, atol=2e-3)


def test_halving_keeps_only_pixels_that_are_valid_all_over():
    grey = as_grey(seen(GROUND, PLACE, (40, 60)))
    valid = ragged((40, 60))
    kept = grey.copy(), valid.copy()
    smaller, inside = halved(grey, valid)
    np.testing.assert_array_equal(inside, valid.reshape(20, 2, 30, 2).all(axis=(1, 3)))
    mean = grey.reshape(20, 2, 30, 2).mean(axis=(1, 3))
    assert np.abs(smaller - mean)[inside].max() <= 0.5 and not smaller[~inside].any()
    assert smaller.dtype == np.uint8 and inside.dtype == bool
    np.testing.assert_array_equal(grey, kept[0])
    np.testing.assert_array_equal(valid, kept[1])


def test_masks_do_not_shift_what_is_seen():
    """A view cut by a mask says of its inner part what the whole view says."""
    whole, cut = (templates_of(GROUND, PLACE, valid=v).at(0) for v in (None, ragged()))
    inner = cv2.erode(ragged().astype(np.uint8), np.ones((9, 9))) > 0
    for group in GROUPS:
        assert alike(whole.channels[group][:, inner], cut.channels[group][:, inner]) > 0.97


@pytest.mark.parametrize("levels", [1, 2, 3, 7, 12])
def test_levels_of_any_view(levels):
    judged = []
    for view_px in (1e-9, 0.5, 1.0, 20.0, 72.0, 110.0, 300.0, 1000.0, 3e4, 1e9):
        made = Levels.of(view_px, levels)
        assert 0 <= made.final <= made.judged <= made.coarse <= levels - 1
        assert made.coarse - made.judged <= 1 and made.judged - made.final <= 1
        if 0 < made.judged < levels - 1:
            assert JUDGED_PX / 1.5 < view_px / 2**made.judged < JUDGED_PX * 1.5
        judged.append(made.judged)
        for level in range(levels):
            assert made.recipe(level) == (COARSE if level > made.judged else FINE)
    assert judged == sorted(judged) and judged[0] == 0 and judged[-1] == levels - 1


def test_the_side_of_a_view_is_the_root_of_what_is_seen():
    valid = np.zeros((96, 128), bool)
    valid[:, :48] = True
    grey = as_grey(seen(GROUND, Pose(100.0, 100.0, 0.0, 0.0), (96, 128)))
    views = ViewTemplates(np.where(valid, grey, 0), valid, 2)
    # The border of what is seen does not count: two pixels.
    assert views.side_px == pytest.approx(4 * math.sqrt(96 * 46), rel=0.01)
