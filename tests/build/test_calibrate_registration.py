"""What a map learns of its own registration: which views to believe, and how dates agree."""

import logging

import numpy as np
import pytest
from builders import built

from helpers import textured
from orthonav.core.localize.confidence import DEFAULT_CONFIDENCE
from orthonav.ground.build.calibrate import CALIBRATION

GREY = textured((240, 240), 11)


@pytest.fixture
def small(make_ortho, tmp_path, monkeypatch):
    """Function that builds a map of 200 x 200 m and gives what it says of registration."""
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 10)
    monkeypatch.setattr("orthonav.ground.build.calibrate.ENOUGH_RIGHT", 6)

    def build(made_of=GREY[20:220, 20:220], *other_dates):
        ortho = make_ortho(tmp_path / "2020.tif", made_of)
        later = [make_ortho(tmp_path / "later.tif", picture) for picture in other_dates]
        with_layer = {"registration": True, "calibration_views": 9, "overlap": 0.875}
        return built(ortho, tmp_path, other_dates=later, **with_layer).manifest.registration

    return build


@pytest.mark.long
def test_a_second_date_sets_the_floor_of_a_map(small):
    """The other picture is the same ground, three pixels to the west and one to the south."""
    plain = small(GREY[20:220, 20:220], GREY[19:219, 23:223])
    assert plain["position_floor_px"] == pytest.approx(10**0.5 / 1.1774, rel=0.1)
    assert plain["confidence"] is not None and plain["radius_m"] > 0


def test_a_uniform_map_has_the_usual_confidence(small):
    plain = small(np.full((200, 200), 99, np.uint8))
    assert plain["confidence"] == DEFAULT_CONFIDENCE.to_plain()
    assert plain["position_floor_px"] == CALIBRATION.floor_px


@pytest.mark.long
@pytest.mark.parametrize(
    "other, warns",
    [
        (np.full((200, 200), 99, np.uint8), True),
        (GREY[20:220, 20:220], True),  # the map's own imagery
        (textured((200, 200), 7), False),
    ],
)
def test_a_second_date_without_the_ground_sets_no_floor(small, caplog, other, warns):
    with caplog.at_level(logging.WARNING):
        assert small(GREY[20:220, 20:220], other)["position_floor_px"] == CALIBRATION.floor_px
    assert ("other dates" in caplog.text) == warns
