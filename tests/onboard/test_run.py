"""From views to results: errors of one view do not end a flight."""

import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orthonav.core.errors import CameraError, FlightError, MissingFileError
from orthonav.core.flight import open_flight
from orthonav.core.localize import Localizer
from orthonav.core.records import NoFix, Prior
from orthonav.ground.recordings.localize import localize_flight
from orthonav.onboard.run import SingleViews

VIEWS = 8


@pytest.fixture(scope="module")
def short(flight):
    """The first views of the flight."""
    return replace(flight, views=flight.views[:VIEWS])


@pytest.fixture
def copied(flight_path, tmp_path):
    """A copy of the flight folder, to be broken."""
    return shutil.copytree(flight_path, tmp_path / "flight")


def outcomes(results):
    return [
        result.outcome.reason if isinstance(result.outcome, NoFix) else "fix" for result in results
    ]


def singly(localizer, flight, *, views=None, skip_bad_images=False, **how):
    """Results of a flight, each view by itself."""
    located = SingleViews(localizer, **how)
    return localize_flight(located, flight, views=views, skip_bad_images=skip_bad_images)


def failing_at(localizer, monkeypatch, number, error):
    """Make the localizer raise `error` inside, at one view."""
    matcher = localizer.tiles.matcher
    whole, calls = matcher.match, []

    def match(*arguments, **keywords):
        calls.append(1)
        if len(calls) == number + 1:
            raise error
        return whole(*arguments, **keywords)

    monkeypatch.setattr(matcher, "match", match)


@pytest.mark.parametrize(
    "error", [ValueError("odd"), ZeroDivisionError(), MemoryError("huge"), np.linalg.LinAlgError()]
)
def test_one_broken_view_does_not_end_a_flight(localizer, short, monkeypatch, caplog, error):
    failing_at(localizer, monkeypatch, 3, error)
    results = list(singly(localizer, short))
    assert outcomes(results) == ["fix"] * 3 + ["internal_error"] + ["fix"] * (VIEWS - 4)
    detail = results[3].outcome.detail
    assert detail.startswith(type(error).__name__) and "\n" not in detail
    assert any(record.exc_info for record in caplog.records)  # the log has the traceback


def test_an_interrupt_ends_it(localizer, short, monkeypatch):
    failing_at(localizer, monkeypatch, 2, KeyboardInterrupt())
    done = []
    with pytest.raises(KeyboardInterrupt):
        done.extend(singly(localizer, short))
    flown = singly(localizer, short)
    assert next(flown).frame == short.views[0].frame


@pytest.mark.parametrize("field", ["lat_deg", "lon_deg", "cov_en_m2"])
def test_a_position_that_is_not_finite_is_no_fix(localizer, short, monkeypatch, field):
    whole = Localizer.locate

    def located(self, *arguments, **keywords):
        fix = whole(self, *arguments, **keywords)
        return replace(fix, **{field: np.full((2, 2), np.nan) if "cov" in field else math.nan})

    monkeypatch.setattr(Localizer, "locate", located)
    assert set(outcomes(singly(localizer, short))) == {"internal_error"}


def test_order_time_and_latency(localizer, short):
    results = list(singly(localizer, short))
    assert [result.frame for result in results] == [view.frame for view in short.views]
    assert [result.time_ns for result in results] == [v.telemetry.time_ns for v in short.views]
    assert all(0 < result.latency_ms < 60_000 for result in results)


def test_results_come_one_by_one(localizer, short):
    """A live flight cannot wait for its end."""
    taken = []

    def views():
        for view in short.views:
            taken.append(view.frame)
            yield view

    flown = singly(localizer, short, views=views())
    for number in range(1, 4):
        next(flown)
        assert len(taken) == number


BREAK = {
    "text": lambda data: b"not a picture",
    "cut": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "noise": lambda data: bytes(np.random.default_rng(0).integers(0, 256, 5000, dtype=np.uint8)),
}


@pytest.mark.parametrize("kind", BREAK)
def test_a_bad_image_is_an_error_or_skipped(localizer, copied, kind):
    flight = open_flight(copied)
    flight = replace(flight, views=flight.views[:4])
    path = Path(flight.views[2].where)
    path.write_bytes(BREAK[kind](path.read_bytes()))
    with pytest.raises(FlightError, match=path.name):
        list(singly(localizer, flight))
    results = list(singly(localizer, flight, skip_bad_images=True))
    assert outcomes(results) == ["fix", "fix", "bad_image", "fix"]
    assert path.name in results[2].outcome.detail and math.isnan(results[2].latency_ms)


def test_a_missing_image_is_named(localizer, copied):
    flight = open_flight(copied)
    Path(flight.views[0].where).unlink()
    with pytest.raises(MissingFileError, match=flight.views[0].frame):
        list(singly(localizer, flight))


def test_a_camera_of_another_aspect_ratio_ends_the_flight(localizer, short):
    wrong = replace(short, camera=short.camera.resized(640, 240))
    for skip in (False, True):
        with pytest.raises(CameraError, match=short.views[0].where):
            list(singly(localizer, wrong, skip_bad_images=skip))


def test_the_prior_is_used_only_where_it_should_be(localizer, short):
    far = Prior(0.0, 0.0, 10.0)
    views = [replace(v, telemetry=replace(v.telemetry, prior=far)) for v in short.views]
    assert set(outcomes(singly(localizer, short, views=views))) == {"outside_map"}
    without = singly(localizer, short, views=views, use_prior=False)
    assert set(outcomes(without)) == {"fix"}


def test_the_heading_may_be_unknown(localizer, short):
    views = [replace(v, telemetry=replace(v.telemetry, yaw_deg=math.nan)) for v in short.views[:3]]
    assert set(outcomes(singly(localizer, short, views=views))) == {"missing_telemetry"}
    found = singly(localizer, short, views=views, heading_known=False)
    assert set(outcomes(found)) == {"fix"}
