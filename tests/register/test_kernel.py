"""The compiled kernel does what NumPy does."""

import importlib
import itertools
import math
import os
import subprocess
import sys

import numpy as np
import pytest
from scenes import Ground, apart_px, as_grey, random_poses, reference_of, templates_of, turned_rad

from orthonav.core.localize import resection
from orthonav.core.localize.view import node_px
from orthonav.core.register import refine, search, template
from orthonav.core.register.kernel import KERNEL
from orthonav.core.register.refine import Refiner
from orthonav.core.register.search import SearchWindow, bank, best_near
from orthonav.core.register.template import COARSE, FINE
from orthonav.core.register.window import MapWindow, Pose, ScaleMap

rectify_module = importlib.import_module("orthonav.core.localize.view")
SHAPE = (256, 320)
GROUND = Ground()
SHARES = refine.BLOCK_GREY_SHARE, refine.MIN_SEEN, refine.MIN_ENERGY
pytestmark = pytest.mark.skipif(KERNEL is None, reason="the kernel was not compiled")


@pytest.fixture(scope="module")
def reference():
    """A map with a hole."""
    valid = np.ones(SHAPE, bool)
    valid[100:130, 60:150] = False
    return reference_of(GROUND, SHAPE, valid)


@pytest.fixture(params=itertools.product((0, 1), (True, False), (True, False)), ids=str)
def views(request, reference, monkeypatch):
    """Twelve views all over the map and beyond its border: templates of a level, each with a pose
    nearby; of all pixels or without a corner; the map is cached or not."""
    level, whole, cached = request.param
    monkeypatch.setattr(reference, "caches", lambda _: cached)
    return list(views_of(12, 5, level, whole))


def views_of(count, seed, level, whole=True):
    valid = np.ones((96, 128), bool)
    valid[:40, 90:] = whole
    for pose in random_poses(count, SHAPE, 10, seed=seed, log_scale=0.15):
        near = Pose(pose.x_px + 2, pose.y_px - 1, pose.heading_rad + 0.03, pose.log_scale - 0.02)
        yield templates_of(GROUND, pose, (96, 128), valid).at(level), near


def both(monkeypatch, work):
    """Pairs of what `work` makes with the kernel, and without it."""
    compiled = work()
    for module in (refine, search, template, resection, rectify_module):
        monkeypatch.setattr(module, "KERNEL", None)
    return list(zip(compiled, work(), strict=True))


def test_steps_lead_to_the_same_place(reference, monkeypatch, views):
    def work():
        for made, near in views:
            fresh = template.Template(made.level, made.planes, made.weights, made.recipe)
            yield Refiner(fresh, reference).place(near, with_covariance=True)

    for one, other in both(monkeypatch, lambda: list(work())):
        assert apart_px(one.pose, other.pose) < 0.05
        assert abs(turned_rad(one.pose, other.pose)) < 2e-3
        assert one.pose.log_scale == pytest.approx(other.pose.log_scale, abs=2e-3)
        assert one.score == pytest.approx(other.score, rel=5e-3, abs=0.02)
        assert one.correlations == pytest.approx(other.correlations, abs=5e-3)
        assert one.overlap == pytest.approx(other.overlap, abs=5e-3)
        assert one.covariance == pytest.approx(other.covariance, rel=0.1, abs=1e-4)


def test_derivatives_are_the_same():
    made, _ = next(views_of(1, 3, 0, whole=False))
    along = np.moveaxis(made.gradients, (0, 1), (3, 2))  # (H, W, 2, 3)
    slopes = made.slopes.reshape(*made.mask.shape, 2, 4)
    assert slopes[..., :3] == pytest.approx(along, abs=1e-6 * float(np.abs(along).max()))
    assert not slopes[..., 3].any()


def test_what_a_covariance_is_made_of_is_the_same(reference, monkeypatch, views):
    def work():
        for made, pose in views:
            window = MapWindow.of(made, reference, pose, refine.DESCENT.slack_px)
            yield Refiner(made, reference)._spread(window, pose)

    for one, other in both(monkeypatch, lambda: list(work())):
        for mine, plain in zip(one, other, strict=True):
            limit = 2e-3 * np.abs(plain).max(axis=0)  # OpenCV rounds positions
            assert (np.abs(mine - plain) <= limit + 1e-9).all()
        assert one.agreement() == pytest.approx(other.agreement(), abs=0.03)
        assert one.blocks_t() == pytest.approx(other.blocks_t(), abs=0.02)


def test_scores_a_little_aside_are_the_same(reference, monkeypatch, views):
    def work():
        return [refine._moved_scores(made, reference, pose) for made, pose in views]

    for one, other in both(monkeypatch, work):
        assert one.shape == other.shape
        for mine, plain in zip(one, other, strict=True):
            assert np.abs(mine - plain).max() <= 1e-2 * np.abs(plain).max() + 1e-9
            assert np.unravel_index(mine.argmax(), mine.shape) == np.unravel_index(
                plain.argmax(), plain.shape
            )


SIZES = [(256, 320), (97, 320), (256, 61), (17, 19), (130, 134)]
"""Heights and widths of windows, searched in transforms of all factors and odd lengths."""


@pytest.mark.parametrize("with_scales", [False, True])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_a_search_finds_the_same_scores_and_poses(reference, monkeypatch, size, with_scales):
    made, _ = next(views_of(1, 7, 1))
    poses = bank(None, 0.1, heading_step_rad=0.6, scale_step=0.13, sigmas=2)
    np.random.default_rng(3).shuffle(poses)  # smaller ones after larger ones
    values = np.random.default_rng(2).uniform(-0.3, 0.3, (9, 11)).astype(np.float32)
    scales = ScaleMap(values, 40.0, 0.05) if with_scales else None

    def work():
        window = SearchWindow(reference.window(1, 10, -20, *size), 1, 10, -20, 60)
        window.prepare(made)
        return search._best_of(made, window, poses, range(2, len(poses)), scales)

    (scores, plain_scores), (numbers, plain_numbers) = both(monkeypatch, work)
    assert scores.shape == size
    assert np.isfinite(scores).tolist() == np.isfinite(plain_scores).tolist()
    seen = np.isfinite(scores)
    assert scores[seen] == pytest.approx(plain_scores[seen], rel=1e-5, abs=1e-4)
    # Where two poses score alike, rounding decides.
    differs = (numbers != plain_numbers) & (abs(plain_scores) > 1e-3)
    assert differs[seen].sum() <= 1e-3 * seen.sum()


@pytest.mark.skipif(not getattr(KERNEL, "AVX2", False), reason="the kernel has no AVX2 here")
def test_without_avx2_the_kernel_does_the_same():
    command = [sys.executable, "-m", "pytest", "-rs", "-p", "no:cacheprovider", "-n", "0", __file__]
    environment = {name: each for name, each in os.environ.items() if "PYTEST" not in name}
    environment["ORTHONAV_NO_AVX2"] = "1"
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:]
    assert "the kernel has no AVX2 here" in done.stdout  # why this test is skipped there


@pytest.mark.parametrize("reach_px", [0.0, 3.0, 14.0])
def test_the_best_place_near_by_is_the_same(reference, monkeypatch, reach_px):
    made, _ = next(views_of(1, 7, 1))
    window = SearchWindow(reference.window(1, 10, -20, 90, 110), 1, 10, -20, 60)
    poses = random_poses(40, SHAPE, -60, seed=3, log_scale=0.2)
    for one, other in both(monkeypatch, lambda: best_near(made, window, poses, reach_px)):
        assert one.score == pytest.approx(other.score, abs=1e-4)
        assert one.score < 1e-3 or apart_px(one.pose, other.pose) < 1e-2


@pytest.mark.parametrize("reach_px", [0, 2, 4, 7])
def test_scores_of_blocks_are_the_same(reference, monkeypatch, views, reach_px):
    def work():
        return [refine.block_scores(made, reference, pose, reach_px) for made, pose in views]

    for one, other in both(monkeypatch, work):
        # OpenCV rounds positions, by which single pixels beside the hole count or not.
        both_used = (one.pixels > 0) & (other.pixels > 0)
        assert ((one.pixels > 0) != (other.pixels > 0)).sum() <= 1
        np.testing.assert_allclose(one.pixels[both_used], other.pixels[both_used], atol=2.5)
        off = one.correlations[both_used] - other.correlations[both_used]
        assert np.abs(off).max(initial=0.0) < 0.05 and np.abs(off).mean() < 3e-3
        np.testing.assert_array_equal(one.middles_px, other.middles_px)


@pytest.mark.parametrize("shape", [(6, 6), (7, 13), (11, 6), (50, 47), (65, 96)])
@pytest.mark.parametrize("reach_px", [0, 1, 4, 7])
def test_scores_of_blocks_where_nothing_is_interpolated_are_exactly_those(
    monkeypatch, shape, reach_px
):
    """Views of any size, down to one pixel to a block, at whole pixels of the map."""
    rng = np.random.default_rng(4)
    made = rng.normal(size=(4, *shape)).astype(np.float32)
    made[3] = rng.uniform(size=shape) > 0.2
    view = template.Template(0, made * made[3], (1.0, 0.6), FINE)
    ground = rng.normal(size=(90, 120, 4)).astype(np.float32)
    ground[..., 3] = rng.uniform(size=(90, 120)) > 0.1
    ground[..., :3] *= ground[..., 3:]
    reference = reference_of(GROUND, (128, 128))
    monkeypatch.setattr(reference, "caches", lambda _: True)
    monkeypatch.setattr(reference, "whole", lambda *_: ground)
    # The last reaches beyond the border; in the first OpenCV's arithmetic is exact too.
    for x, y, quarter in [(50, 40, 0), (70, 45, 1), (10, 80, 2)]:
        rows, cols = shape if quarter % 2 == 0 else shape[::-1]
        pose = Pose(x + cols % 2 / 2, y + rows % 2 / 2, quarter * math.pi / 2, 0.0)
        window = MapWindow.of(view, reference, pose, 1, (reach_px, reach_px))
        sums = refine._products_of_blocks(view, window, pose, reach_px)
        plain, plain_pixels = refine._correlated(*sums, math.prod(shape))
        found, pixels = np.full_like(plain, math.nan), np.full_like(plain_pixels, math.nan)
        at = window.matrix(pose), pose.heading_rad, reach_px, SHARES
        KERNEL.blocks(window.made, view.planes, *at, found, pixels)
        assert pixels.any()
        np.testing.assert_allclose(pixels, plain_pixels, rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(found, plain, atol=2e-4)


def blocks_of(surfaces, levels, rng):
    """Blocks of so many levels with these correlations; some do not count."""
    pixels = rng.uniform(200, 900, len(surfaces)) * (rng.uniform(size=len(surfaces)) > 0.1)
    count = len(surfaces) // levels
    units = np.repeat(2.0 ** np.arange(levels), count)
    moved_px = rng.normal(size=(count, 2, 6))
    return resection.Blocks(levels, 2.0, surfaces, pixels, units, moved_px)


@pytest.mark.parametrize("side", [3, 9, 15])
@pytest.mark.parametrize("blur_px", [0.0, 0.7, 2.0])
@pytest.mark.parametrize("levels", [1, 2, 3])
def test_pulls_of_blocks_are_the_same(monkeypatch, side, blur_px, levels):
    """At the border of a surface and beyond it too, and at saddles and pits."""
    rng = np.random.default_rng(6)
    surfaces, reach = rng.normal(size=(300, side, side)) / 2, side // 2
    moved = rng.uniform(-1.3 * reach, 1.3 * reach, (300, 2))
    moved[:40] = rng.integers(-reach, reach + 1, (40, 2))
    moved[40:80] = rng.integers(-reach, reach, (40, 2)) + 0.5
    surfaces[80:90] = 0.0
    blocks = blocks_of(surfaces, levels, rng)
    for one, other in both(monkeypatch, lambda: blocks._pulls(moved, blur_px)):
        assert other.any()
        np.testing.assert_allclose(one, other, atol=1e-10 * np.abs(other).max())


def test_blocks_of_which_nothing_counts_do_not_pull(monkeypatch):
    rng = np.random.default_rng(6)
    blocks = blocks_of(rng.normal(size=(72, 9, 9)), 2, rng)
    blocks.pixels[:] = 0.0
    for pulls in both(monkeypatch, lambda: blocks._pulls(np.zeros((72, 2)), 0.0)):
        assert not any(each.any() for each in pulls)


SOLVER = resection.SOLVER
LIMITS = SOLVER.min_correlation, SOLVER.max_correlation, SOLVER.pixels_per_number


@pytest.mark.parametrize("factor", [2, 3, 4, 7, 16, 37])
def test_pictures_are_made_smaller_as_by_opencv(monkeypatch, factor):
    grey = np.random.default_rng(factor).integers(0, 256, (149, 203)).astype(np.uint8)
    height, width = 149 // factor, 203 // factor
    used = grey[: height * factor, : width * factor]
    mean = used.reshape(height, factor, width, factor).mean(axis=(1, 3))
    ((compiled, plain),) = both(monkeypatch, lambda: [rectify_module._thinned(used, factor)])
    assert np.abs(compiled - mean).max() <= 0.5 + 1e-4
    np.testing.assert_array_equal(compiled, plain)


@pytest.mark.parametrize("shape", [(160, 180), (37, 18), (1, 1), (4, 5)], ids=str)
def test_pictures_are_rectified_as_without_the_kernel(monkeypatch, shape):
    """Windows reach beyond the picture, and some nodes are not usable."""
    rng = np.random.default_rng(7)
    picture = as_grey(GROUND(np.arange(150.0)[None], np.arange(90.0)[:, None]))
    px = node_px(shape)
    nodes = np.stack([1.1 * px[..., 0] - 0.2 * px[..., 1] - 9, 0.7 * px[..., 1] - 3], axis=-1)
    nodes += 1e-3 * px**2
    nodes[rng.uniform(size=nodes.shape[:2]) < 0.05] = np.nan
    (compiled, plain), (seen, plain_seen) = both(
        monkeypatch, lambda: rectify_module._at_nodes(picture, nodes, shape)
    )
    assert (seen != plain_seen).mean() < 0.005
    common = seen & plain_seen
    assert common.any() == (min(shape) > 5)
    # OpenCV rounds positions to 1/32 of a pixel.
    assert np.abs(compiled[common].astype(int) - plain[common]).max(initial=0) <= 2
    assert not compiled[~seen].any()


@pytest.mark.parametrize("recipe", [FINE, COARSE], ids=["fine", "coarse"])
@pytest.mark.parametrize("valid", ["all", "none", "part", "scattered"])
@pytest.mark.parametrize(
    "shape", [(64, 96), (97, 41), (1, 1), (1, 9), (5, 3), (9, 31), (8, 8)], ids=str
)
def test_channels_are_the_same(shape, valid, recipe):
    """At borders too, and of pictures smaller than the windows."""
    rng = np.random.default_rng(5)
    grey = (rng.integers(0, 256, shape) // 2 + np.arange(shape[1])).astype(np.uint8)
    which = np.full(shape, valid != "none")
    if valid == "part":
        which[: shape[0] // 3, shape[1] // 2 :] = False
    elif valid == "scattered":
        which = rng.uniform(size=shape) > 0.1
    compiled = template.channel_planes(grey, which, recipe)
    plain = np.stack(template._planes(grey, which, recipe, bool(which.all())))
    np.testing.assert_array_equal(compiled[3], plain[3])
    np.testing.assert_allclose(compiled, plain, atol=1e-4)


def test_channels_of_a_uniform_picture_are_zero():
    grey = np.full((40, 50), 90, np.uint8)
    compiled = template.channel_planes(grey, np.ones(grey.shape, bool), FINE)
    assert not compiled[:3].any()


def zeros(*shape, of=np.float32):
    return np.zeros(shape, of)


def given(name):
    """Arguments that a function of the kernel takes."""
    made = templates_of(GROUND, Pose(150, 120, 0, 0)).at(1)
    view, window = (made.values, made.weights), zeros(20, 30, 4)
    images = window, made.values, made.slopes, made.numbers
    grey, upright = zeros(20, 30, of=np.uint8), (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    best, numbers = zeros(3, 40, 16), zeros(3, 40, 16, of=np.int32)
    four, valid = np.ones(4), zeros(20, 30, of=bool)
    surfaces = np.zeros((4, 5, 5)), np.zeros((5, 5)), np.zeros((4, 2))
    return {
        "refine": (*images, (0,) * 4, (0, 0, 1, 0, 0, 0, 0, 0, 0)),
        "spread": (*images, (0,) * 4, (0, 0, 1, 0, 0, 0, 0, 0, 0), np.zeros(2 * 16 + 36 * 7)),
        "search": (zeros(3, 3, 45, 16), *view, np.zeros((1, 4)), 0, best, numbers, best.copy()),
        "near": (zeros(20, 30, 3), *view, np.zeros((1, 4)), 2, np.zeros((1, 3))),
        "moved": (window, *view, upright, 0.0, (3, 4), (80, 100), 1e-3, zeros(3, 7, 9)),
        "blocks": (
            window,
            made.planes,
            upright,
            0.0,
            2,
            SHARES,
            np.zeros((36, 5, 5)),
            np.zeros(36),
        ),
        "bend": (*surfaces, four, four.copy(), LIMITS, np.zeros((2, 6))),
        "channels": (grey, valid, (1.0, 27, 11, 21), zeros(4, 20, 30)),
        "thin": (zeros(12, 16, of=np.uint8), 4, zeros(3, 4, of=np.uint8)),
        "rectify": (grey[:9], zeros(6, 9, 2), grey.copy(), valid),
    }[name]


LIMITS_OF_STEPS = (0, 0, 1, 3, 0.01, 3.0, 1e-3, 0.08, 0.97)
POSES = [(1e9, 0, 0, 0), (math.nan, 0, 0, 0), (0, 0, 0, 80.0)]
MATRICES = [(math.nan,) * 6, (1e30, 0, 1e30, 0, 1e30, 1e30), (1, 0, -1e9, 0, 1, 1e9)]
PLACES = [(1e300, 0, 0, 0), (math.nan, -1e300, 0, 0), (5, 5, 0, 80.0), (5, 5, 0, math.nan)]
OFF = [(math.nan, 0.0), (0.0, math.inf), (-1e300, 1e300), (0.0, -math.inf)]
NODES = np.full((6, 9, 2), 1e30, np.float32)
NODES[:3], NODES[4] = np.nan, -np.inf
BEYOND = [
    *[("refine", 4, pose) for pose in POSES],
    *[("spread", 4, pose) for pose in POSES],
    *[(name, at, matrix) for name, at in (("moved", 3), ("blocks", 2)) for matrix in MATRICES],
    *[("near", 3, np.array([place])) for place in PLACES],
    *[("bend", 2, np.array(OFF)), ("rectify", 1, NODES)],
]


@pytest.mark.parametrize("name, at, beyond", BEYOND)
def test_what_lies_beyond_all_bounds_touches_no_memory(name, at, beyond):
    arguments = list(given(name))
    arguments[0] = np.ones_like(arguments[0])
    arguments[at] = beyond
    if name in ("refine", "spread"):
        arguments[5] = LIMITS_OF_STEPS
    outputs = arguments[OUTPUTS.get(name, len(arguments)) :]
    for each in outputs:
        each[...] = 1 if each.dtype.kind in "bu" else math.nan
    found = getattr(KERNEL, name)(*arguments)
    if name == "refine":
        assert found[1] == 0 or math.isnan(found[1])
    elif name == "spread":
        assert not outputs[0][:16].any() and not outputs[0][32:].any()
    elif name == "near":
        assert outputs[0][0, 0] == 0
    else:
        assert not any(each.any() for each in outputs)


OUTPUTS = {"spread": 6, "near": 5, "moved": 8, "blocks": 6, "bend": 6, "rectify": 2}
"""Number of the first argument that is written to."""


def other_type(array):
    return array.astype(np.float64 if array.dtype == np.float32 else np.float32)


def strided(array):
    return np.repeat(array, 2, axis=-1)[..., ::2]


def shorter(array):
    return array[:-1].copy()


def narrower(array):
    return array[..., :-1].copy()


def empty(array):
    return array[:0]


def of(value):
    """Another value in place of any argument."""
    return lambda _: value


DAMAGED = {
    shorter: {"refine": (2, 3), "spread": (3, 6), "search": (5, 6, 7), "blocks": (1, 6, 7)}
    | {"bend": range(5), "channels": (1, 3), "thin": (2,), "rectify": (1, 3)},
    narrower: {"refine": (0,), "near": (5,), "moved": (0, 8), "blocks": (0, 6), "bend": (6,)},
    empty: {"search": (0,), "moved": (1,), "bend": (6,), "channels": (0,)},
}
"""Positions of arguments by what is done to them and by function."""
REFUSED = [
    *((name, at, do) for do, of_ in DAMAGED.items() for name, ats in of_.items() for at in ats),
    ("search", 0, lambda each: each[:, :, :-1].copy()),
    ("search", 0, lambda each: np.concatenate([each, each[:1]])),
    ("moved", 1, lambda each: each[:, :0].copy()),
    *(("moved", 5, of((-3, 4))), ("moved", 6, of((77, 100))), ("moved", 6, of((50, 100)))),
    ("blocks", 1, lambda each: each[:, :5].copy()),
    *(("blocks", 4, of(3)), ("blocks", 4, of(-1))),
    ("bend", 0, lambda each: each[:, :4, :4].copy()),
    ("bend", 0, lambda each: each[:, :1, :1].copy()),
    *(("bend", 0, of(np.zeros((4, 65, 65)))), ("bend", 6, of(np.zeros((3, 6))))),
    *(("channels", 2, of((1.0, 27, 10, 21))), ("channels", 2, of((math.nan, 27, 11, 21)))),
    *(("thin", 1, of(257)), ("thin", 1, of(0))),
]


@pytest.mark.parametrize("name, at, damage", REFUSED)
def test_arguments_that_do_not_match_are_refused(name, at, damage):
    arguments = given(name)
    with pytest.raises(ValueError, match=r"match|expected|contiguous|products|window"):
        getattr(KERNEL, name)(*arguments[:at], damage(arguments[at]), *arguments[at + 1 :])


@pytest.mark.parametrize("damage", [other_type, strided, of(None)])
@pytest.mark.parametrize("name", sorted({name for name, *_ in REFUSED}))
def test_other_arrays_are_refused(name, damage):
    arguments = given(name)
    getattr(KERNEL, name)(*arguments)
    for at, each in enumerate(arguments):
        may_miss = (name, at) in (("search", 7), ("bend", 1), ("channels", 1))
        if not isinstance(each, np.ndarray) or (damage(each) is None and may_miss):
            continue
        with pytest.raises((ValueError, TypeError)):
            getattr(KERNEL, name)(*arguments[:at], damage(each), *arguments[at + 1 :])
