"""A bank of poses: close to turning, representing and embedding the view again for each of them."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import textured
from orthonav.core.tiles import represent
from orthonav.core.tiles.bank import embed_directions
from orthonav.core.tiles.whitened import CellLayout, CellSheet, WhitenedRecipe
from orthonav.core.variants import make_variant
from orthonav.ground.build.whitening import learn

TILE_PX = 128
GROUND_PX = 640
MIDDLE = GROUND_PX / 2
WHOLE = (256, 341)
STEP_RAD, SCALE_STEP = math.radians(8), 0.13


def warped(picture, shape, linear, at, flags=cv2.INTER_LINEAR):
    """Picture of `shape` whose point u px from its middle shows `at + linear @ u` of another."""
    height, width = shape
    half = np.array([width / 2, height / 2])
    move = np.asarray(at) - linear @ half + linear @ [0.5, 0.5] - 0.5
    matrix = np.column_stack([linear, move])
    return cv2.warpAffine(picture, matrix, (width, height), flags=flags | cv2.WARP_INVERSE_MAP)


def linear_of(turn, log_scale):
    cos, sin = math.cos(turn), math.sin(turn)
    return math.exp(log_scale) * np.array([[cos, -sin], [sin, cos]])


class Place:
    """Ground with tiles every 16 px, and an embedder learnt on them."""

    def __init__(self, name="gradient", cells=8):
        self.representation = make_variant(represent.TABLE, name)
        self.grey = cv2.GaussianBlur(textured((GROUND_PX, GROUND_PX)), (0, 0), 1.5)
        valid = np.ones(self.grey.shape, bool)
        maps = self.representation(self.grey, valid)
        self.sheet = CellSheet(CellLayout.for_tiles(TILE_PX, 16), *self.grey.shape, len(maps))
        self.sheet.fill(0, 0, maps, valid)
        along = np.arange(0, GROUND_PX - TILE_PX + 1, 16)
        self.tiles_px = np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(-1, 2)
        self.embedder = learn(WhitenedRecipe(cells=cells, dims=64), self.sheet, self.tiles_px)
        self.tiles = self.embedder.tiles(self.sheet, self.tiles_px).astype(np.float32)
        self.middle_tile = int(np.flatnonzero((self.tiles_px == 256).all(axis=1))[0])

    def view(self, turn, log_scale, shape=WHOLE):
        """What a camera over the middle sees, its top at the top, without a scale error."""
        grey = warped(self.grey, shape, linear_of(turn, log_scale), (MIDDLE, MIDDLE))
        return grey, np.ones(shape, bool)

    def slow(self, grey, valid, turn, log_scale):
        """The embedding of a view turned north up as a picture."""
        height, width = grey.shape
        linear, at = np.linalg.inv(linear_of(turn, log_scale)), (width / 2, height / 2)
        square = (TILE_PX, TILE_PX)
        seen = warped(valid.astype(np.uint8), square, linear, at, cv2.INTER_NEAREST) > 0
        north_up = np.where(seen, warped(grey, square, linear, at), 0).astype(np.uint8)
        return self.embedder.view(self.representation(north_up, seen), seen)

    def bank(self, grey, valid, poses):
        return embed_directions(self.embedder, self.representation, grey, valid, poses, TILE_PX)

    def likeness(self, grey, valid, poses):
        """Cosines (Q,) of bank and slow path."""
        slow = np.stack([self.slow(grey, valid, *pose) for pose in poses])
        return np.einsum("qd,qd->q", self.bank(grey, valid, poses), slow)


@pytest.fixture(scope="module")
def place():
    return Place()


def random_poses(count, scale=0.26, seed=0):
    rng = np.random.default_rng(seed)
    turns, scales = rng.uniform(-7, 7, count), rng.uniform(-scale, scale, count)
    return list(zip(turns.tolist(), scales.tolist(), strict=True))


@settings(max_examples=25, deadline=None)
@given(st.floats(-math.pi, math.pi), st.floats(-0.26, 0.26))
def test_under_its_true_pose_a_view_looks_like_its_tile(place, turn, log_scale):
    grey, valid = place.view(turn, log_scale)
    seen = place.bank(grey, valid, [(turn, log_scale)])[0]
    scores = place.tiles @ seen
    assert scores.argmax() == place.middle_tile and scores[place.middle_tile] > 0.85


def test_close_to_the_slow_path(place):
    poses = random_poses(100)
    likeness = place.likeness(*place.view(0.4, 0.0), poses)
    assert np.median(likeness) > 0.97 and likeness.min() > 0.9


@pytest.mark.parametrize("name, least", [("gray", 0.98), ("canny", 0.5)])
def test_one_channel_is_only_turned(name, least):
    """Which edges Canny finds depends on their direction: there the bank is a poor substitute."""
    place = Place(name, cells=16)
    likeness = place.likeness(*place.view(0.4, 0.0), random_poses(30, scale=0.13))
    assert np.median(likeness) > least
    grey, valid = place.view(2.0, 0.1)
    seen = place.bank(grey, valid, [(2.0, 0.1)])[0]
    assert (place.tiles @ seen).argmax() == place.middle_tile


def test_what_is_not_valid_does_not_count(place):
    grey, valid = place.view(1.0, 0.1)
    valid[:, :150] = False
    hidden = np.where(valid, grey, 0).astype(np.uint8)
    poses = random_poses(40, scale=0.13)
    assert np.median(place.likeness(hidden, valid, poses)) > 0.9
    other = np.where(valid, grey, 255 - grey[::-1]).astype(np.uint8)
    np.testing.assert_allclose(
        place.bank(hidden, valid, poses), place.bank(other, valid, poses), atol=1e-4
    )


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (256, 341)])
def test_views_without_content_are_finite(place, shape):
    poses = [*random_poses(3), (0.0, 4.0), (0.0, -4.0)]
    grey = np.full(shape, 77, np.uint8)
    assert not place.bank(grey, np.zeros(shape, bool), poses).any()
    assert np.isfinite(place.bank(grey, np.ones(shape, bool), poses)).all()
