"""Views that the default places wrongly: found where they are, and drawn."""

from dataclasses import replace

import numpy as np
import pytest
from experiments.paper import exceptions, scenes
from experiments.paper.trajectories import TABLE_1

SMALL = replace(TABLE_1["B"], length_m=128.0, band_m=64.0)


@pytest.mark.slow  # an experiment
def test_only_views_beyond_the_radius_are_shown(tmp_path, area, monkeypatch):
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 8)
    scene = scenes.Scene("B", area.past, area.past, SMALL)
    localizer = exceptions.localizer_of(scene, tmp_path)
    assert list(exceptions.wrong(scene, localizer, 2)) == []
    monkeypatch.setattr(exceptions, "ACCURACY_M", -1.0)
    title, pictures = next(exceptions.wrong(scene, localizer, 2))
    assert title.startswith("0 m off") and len(pictures) == len(exceptions.ROWS)
    for each in pictures[1:]:  # the map of the same date is the view itself
        assert np.corrcoef(each.ravel(), pictures[0].ravel())[0, 1] > 0.95


def test_each_view_has_a_column():
    pictures = [np.zeros((8, 8), np.uint8)] * len(exceptions.ROWS)
    figure = exceptions.draw([("one", pictures), ("two", pictures)])
    assert [each.get_title() for each in figure.axes if each.get_title()] == ["one", "two"]
    assert "no view" in exceptions.draw([]).axes[0].get_title()
