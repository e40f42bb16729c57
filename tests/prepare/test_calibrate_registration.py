"""What a map learns of its own registration: which views to believe, and how dates agree."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from helpers import textured
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.confidence import USUAL_CONFIDENCE, RegisteredConfidence
from orthonav.core.localize.localizer import RegistrationLocalizer
from orthonav.core.mapfile import SheetInfo, open_map
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.build import calibrate as module
from orthonav.ground.build.calibrate import FLOOR_LIMITS_PX, FLOOR_PX, Crop, calibrate_registration
from orthonav.ground.build.layer import halved

SIDE_PX, TILE_PX = 240, 64
CROP_PX = round(1.5 * TILE_PX)
FEW = 10


class Pyramid:
    """A picture at several resolutions, all of it valid."""

    levels = 4

    def __init__(self, grey):
        self._pictures = [(grey, np.ones(grey.shape, bool))]
        for _ in range(self.levels - 1):
            self._pictures.append(halved(*self._pictures[-1]))

    def shape(self, level):
        return self._pictures[level][0].shape

    def read(self, level, row, col, height, width):
        far = max(height, width) + 8
        grey, valid = (np.pad(each, far) for each in self._pictures[level])
        rows, cols = self.shape(level)
        top, left = (
            min(max(at, -far), size + far - side) + far
            for at, size, side in ((row, rows, height), (col, cols, width))
        )
        part = np.s_[top : top + height, left : left + width]
        return grey[part], valid[part]


GREY = textured((SIDE_PX, SIDE_PX))


@pytest.fixture(scope="module")
def localizer():
    half_m = SIDE_PX / 2
    grid = TileGrid(-half_m, half_m, 1.0, TILE_PX, 16, 12, 12)
    assert grid.width_px == grid.height_px == SIDE_PX
    sheet = SheetInfo(LocalFrame(46.5, 2.5), grid, 144, 0.06)
    return RegistrationLocalizer(
        sheet, Pyramid(GREY), confidence=None, radius_m=10.0, floor_px=FLOOR_PX
    )


@pytest.fixture(autouse=True)
def few_will_do(monkeypatch):
    monkeypatch.setattr(module, "ENOUGH_RIGHT", 6)


def crops_of(grey, count=FEW, seed=0, moved_px=(0, 0)):
    """Crops at random places of `GREY`; what is cut there of `grey` lies `moved_px` beside."""
    rng = np.random.default_rng(seed)
    found = []
    for row, col in rng.integers(8, SIDE_PX - CROP_PX - 8, (count, 2)):
        y, x = row + moved_px[1], col + moved_px[0]
        part = grey[y : y + CROP_PX, x : x + CROP_PX]
        found.append(Crop(part.copy(), float(row + CROP_PX / 2), float(col + CROP_PX / 2)))
    return found


def calibrated(localizer, crops, later=(), seed=0, report=lambda stage, share: None):
    return calibrate_registration(localizer, crops, list(later), FEW, seed, report)


@pytest.fixture(scope="module")
def learnt(localizer):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "ENOUGH_RIGHT", 6)
        return calibrated(localizer, crops_of(GREY))


def test_the_same_seed_gives_the_same(localizer, learnt):
    assert calibrated(localizer, crops_of(GREY)) == learnt


def verdicts(localizer, confidence, crops, mirrored):
    """Confidence in views of crops as they are, and how far from the truth they were placed."""
    rng = np.random.default_rng(5)
    said, off = [], []
    for crop in crops:
        picture = np.ascontiguousarray(crop.grey[:, ::-1]) if mirrored else crop.grey
        view = module._view(rng, picture, localizer.grid)
        best = localizer.search(view).run()
        said.append(confidence(best.scores))
        pose = best.pose
        off.append(np.hypot(pose.x_px - crop.col_px, pose.y_px - crop.row_px))
    return np.array(said), np.array(off)


def test_views_of_the_map_are_confident_and_mirrored_ones_are_not(localizer, learnt):
    fresh = crops_of(GREY, 8, seed=9)
    own, off = verdicts(localizer, learnt.confidence, fresh, mirrored=False)
    false, _ = verdicts(localizer, learnt.confidence, fresh, mirrored=True)
    assert off.max() < 0.5  # views are cut where the crops say, to half a pixel
    assert own.min() > 0.8 and np.median(false) < 0.3
    assert own.min() > false.max()


@pytest.mark.parametrize(
    "moved_px, expected",
    [
        ((0, 0), FLOOR_LIMITS_PX[0]),
        ((-2, 1), 5**0.5 / 1.1774),
        pytest.param((6, 3), FLOOR_LIMITS_PX[1], marks=pytest.mark.slow),
    ],
)
def test_the_floor_is_the_offset_of_the_other_date(localizer, moved_px, expected):
    later = crops_of(GREY, 8, seed=2, moved_px=moved_px)
    found = calibrated(localizer, crops_of(GREY, 2), later)
    assert found.floor_px == pytest.approx(expected, rel=0.06)


def test_another_place_does_not_count_as_another_date(localizer):
    """What is not found at its place is wrong, not badly registered."""
    later = crops_of(textured((SIDE_PX, SIDE_PX), 7), 8, seed=2)
    assert calibrated(localizer, crops_of(GREY, 2), later).floor_px == FLOOR_PX


def test_mirrored_views_measure_chance_only(localizer, learnt):
    chances = learnt.confidence.chances
    assert learnt.confidence == RegisteredConfidence.usual(chances) != USUAL_CONFIDENCE
    few = calibrated(localizer, crops_of(GREY, module.MIN_NEGATIVES - 1))
    assert few.confidence == USUAL_CONFIDENCE


@pytest.fixture
def small(make_ortho, tmp_path, monkeypatch):
    """Function that builds a map of 200 x 200 m and gives what it says of registration."""
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 10)
    grey = textured((240, 240), 11)

    def build(made_of=grey[20:220, 20:220], *other_dates, nodata=None):
        ortho = make_ortho(tmp_path / "2020.tif", made_of, nodata=nodata)
        later = [make_ortho(tmp_path / "later.tif", picture) for picture in other_dates]
        request = BuildRequest([ortho], tmp_path / "map.onav", tile_px=64, other_dates=later)
        build_map(replace(request, calibration_views=9))
        return open_map(request.out).manifest.registration

    build.grey = grey
    return build


@pytest.mark.long
def test_a_second_date_sets_the_floor_of_a_map(small):
    """The other picture is the same ground, three pixels to the west and one to the south."""
    grey = small.grey
    plain = small(grey[20:220, 20:220], grey[19:219, 23:223])
    assert plain["position_floor_px"] == pytest.approx(10**0.5 / 1.1774, rel=0.1)
    assert plain["confidence"] is not None and plain["radius_m"] > 0


def test_a_uniform_map_has_the_usual_confidence(small):
    plain = small(np.full((200, 200), 99, np.uint8))
    assert plain["confidence"] == USUAL_CONFIDENCE.to_plain()
    assert plain["position_floor_px"] == FLOOR_PX


@pytest.mark.long
def test_a_second_date_without_texture_gives_a_warning(small, caplog):
    with caplog.at_level(logging.WARNING):
        plain = small(small.grey[20:220, 20:220], np.full((200, 200), 99, np.uint8))
    assert plain["position_floor_px"] == FLOOR_PX
    assert "other dates" in caplog.text
