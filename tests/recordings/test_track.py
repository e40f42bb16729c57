"""Series over time: between samples, across north and the 180th meridian, and where nothing is."""

import math
from dataclasses import replace

import pytest

from orthonav.core.errors import UsageError
from orthonav.core.flight.recording import RecordedView
from orthonav.core.geo.attitude import enu_from_body_camera, ned_from_angles
from orthonav.core.tilt import ARDUPILOT, GIMBAL, MOUNT_STD_DEG, UNSTATED, stated_deg
from orthonav.ground.recordings.recording import SourceOptions, warnings_of, with_mean_velocities
from orthonav.ground.recordings.telemetry_track import (
    GAP_NS,
    RecordedTrack,
    Samples,
    angles_at,
    attitude_of_angles,
)

S = 10**9


def attitudes(*samples):
    collected = Samples(3)
    for time_s, *angles in samples:
        collected.add(round(time_s * S), *angles)
    return attitude_of_angles(
        collected, lambda telemetry: enu_from_body_camera(ned_from_angles(telemetry))
    )


@pytest.mark.parametrize(
    "first, last, middle", [(350, 20, 5), (20, 350, 5), (80, 100, 90), (179, 181, 180)]
)
def test_headings_turn_the_short_way(first, last, middle):
    series = attitudes((0, first, 0, 0), (1, last, 0, 0))
    assert angles_at(series, S // 2) == pytest.approx((middle, 0, 0), abs=1e-9)
    assert angles_at(series, 0)[0] == pytest.approx(first)


def test_a_heading_that_is_not_known_is_not_made_up():
    series = attitudes((0, math.nan, 5, 1), (1, 90, 7, 1), (2, 90, 9, 1))
    yaw, pitch, roll = angles_at(series, S // 4)
    assert math.isnan(yaw) and (pitch, roll) == pytest.approx((5, 1))
    assert angles_at(series, 3 * S // 2) == pytest.approx((90, 8, 1), abs=0.01)


def test_outside_and_in_gaps_nothing_is_known():
    series = attitudes((0, 0, 0, 0), (1, 0, 0, 0), (1 + GAP_NS / S + 0.1, 0, 0, 0))
    assert not math.isnan(angles_at(series, S)[0])
    for time_ns in (-1, S + 1, 4 * S):
        assert all(math.isnan(angle) for angle in angles_at(series, time_ns))
    bare = RecordedTrack(series).telemetry(S // 2)
    assert bare.missing() == ["agl_m"] and bare.prior is None and bare.vel_en_mps is None


def test_samples_come_in_any_order_and_what_is_no_number_is_dropped():
    samples, start = Samples(1), 1_700_000_000_123_456_789
    for time_ns, value in ((3, 30.0), (1, 10.0), (2, math.nan), (1, 99.0), (5, math.inf)):
        samples.add(start + time_ns, value)
    samples.add(2**70, 1.0)
    samples.add(10**17, 1.0)  # decades off the others
    series = samples.series()
    assert (series.time_ns - start).tolist() == [1, 3]
    assert series.values[:, 0].tolist() == [10, 30] and series.at(start + 2) == 20.0
    assert Samples(2).series() is None and Samples(3).positions() is None


def test_positions_cross_the_180th_meridian():
    samples = Samples(3)
    samples.add(0, 10.0, 179.9, 100.0)
    samples.add(S, 10.0, -179.9, math.nan)
    samples.add(2 * S, 0.0, 0.0, 0.0)  # "no position"
    track = RecordedTrack(None, position=samples.positions())
    assert track.latlon_deg(S // 2) == pytest.approx((10, -180))
    assert track.latlon_deg(S)[1] == pytest.approx(-179.9)
    assert track.latlon_deg(S + S // 2) is None


def series(*timed):
    samples = Samples(len(timed[0]) - 1)
    for time_s, *values in timed:
        samples.add(round(time_s * S), *values)
    return samples.positions() if len(values) == 3 else samples.series()


def test_the_better_height_counts_where_it_is_there():
    place = series(*[(t, 46.0, 2.0, 400.0) for t in (0, 2, 4)])
    heights = series((0, 50.0), (1, 52.0)), series((0, 80.0), (2, 80.0))
    track = RecordedTrack(None, heights, position=place)
    heights = [track.telemetry(t).agl_m for t in (S // 2, 3 * S // 2, 3 * S)]
    assert heights[:2] == [51.0, 80.0] and math.isnan(heights[2])
    assert track.telemetry(3 * S, ground_alt_m=310.0).agl_m == 90.0


def test_heights_of_different_references_are_not_taken_for_each_other():
    altitudes = {"amsl": series((0, 400.0), (1, 400.0)), "hae": series((0, 450.0))}
    reported = RecordedTrack(None, home=series((0, 50.0)), **altitudes).telemetry(0)
    assert (reported.home_m, reported.amsl_m, reported.hae_m) == (50.0, 400.0, 450.0)
    assert reported.agl_m == 50.0  # level ground assumed, and said
    only = RecordedTrack(None, **altitudes)
    assert math.isnan(only.telemetry(0).agl_m)
    assert only.telemetry(0, ground_alt_m=290.0).agl_m == 110.0
    both = RecordedTrack(None, position=series((0, 46.0, 2.0, 450.0)), **altitudes)
    assert both.telemetry(0, ground_alt_m=290.0).agl_m == 160.0
    assert math.isnan(both.telemetry(S, ground_alt_m=290.0).agl_m)


@pytest.mark.parametrize(
    "names, options, expected",
    [
        ((), {}, None),
        (("home",), {}, "level ground is assumed"),
        (("amsl",), {}, "only altitudes, which are not taken for one; give --ground-alt-m"),
        (("amsl",), {"ground_alt_m": 290.0}, "is the recorded altitude minus 290 m"),
        (("home", "amsl"), {"ground_alt_m": 290.0}, "level ground is assumed"),
    ],
)
def test_what_is_assumed_about_heights_is_said_once(names, options, expected):
    track = RecordedTrack(None, **dict.fromkeys(names, series((0, 50.0))))
    doubts = warnings_of(track, SourceOptions(**options))
    assert len(doubts) == (expected is not None)
    assert expected is None or expected in doubts[0]


def tilt(track, time_ns=S):
    telemetry = track.telemetry(time_ns)
    return telemetry.tilt_std_deg, telemetry.mount_std_deg


def test_tilt_has_a_standard_deviation_by_the_kind_of_the_source():
    """Or as reported; unknown where pitch and roll are."""
    attitude = attitudes((0, 10.0, 1.0, -2.0), (2, 10.0, 1.0, -2.0))
    placed = series((0, 46.0, 2.0, 300.0), (1.5, 46.0, 2.0, 300.0))
    mount = MOUNT_STD_DEG
    assert tilt(RecordedTrack(attitude)) == (math.hypot(3, mount), mount)
    with_gnss = RecordedTrack(attitude, position=placed)
    assert tilt(with_gnss) == (math.hypot(1, mount), mount)
    assert tilt(with_gnss, 2 * S) == (math.hypot(3, mount), mount), "GNSS was lost before"
    assert tilt(RecordedTrack(attitude, tilt=ARDUPILOT)) == (math.hypot(1, mount), mount)
    assert tilt(RecordedTrack(attitude, tilt=GIMBAL)) == (0.5, None)
    stated = RecordedTrack(attitude, horizon_std=series((0, 0.3), (2, 0.3)))
    assert tilt(stated) == (math.hypot(0.3, mount), mount)
    reported = RecordedTrack(attitude, tilt=UNSTATED, tilt_std=series((0, 0.5), (0.5, 0.7)))
    assert tilt(reported, 0) == (0.5, None) and tilt(reported) == (3.0, None)
    apart = replace(reported, mount_std=series((0, 0.3), (0.5, 0.3)))
    assert tilt(apart, 0) == (0.5, 0.3)
    assert apart.telemetry(0).horizon_std_deg == pytest.approx(0.4)
    assert tilt(RecordedTrack(None)) == (None, None)


@pytest.mark.parametrize(
    ("variances", "expected"),
    [
        ((0.0, 0.0), None),
        ((-1.0, 0.0), None),
        ((math.radians(0.1) ** 2,) * 2, 0.3),
        ((math.radians(5) ** 2, math.radians(2) ** 2), 5.0),
        ((1.0, 1.0), None),  # of MAVROS
        ((math.nan, 0.0), None),
    ],
)
def test_a_message_states_its_horizon_or_a_placeholder(variances, expected):
    assert stated_deg(variances) == (None if expected is None else pytest.approx(expected))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"rate_hz": 0.0}, "rate_hz"),
        ({"prior_std_m": -1.0}, "prior_std_m"),
        ({"time_offset_s": math.inf}, "finite"),
        ({"topics": {"depth": "/d"}}, "image, camera_info"),
    ],
)
def test_impossible_options_are_refused(change, message):
    with pytest.raises(UsageError, match=message):
        SourceOptions(**change)


def seen_at(velocities, *times_s):
    track = RecordedTrack(None, velocity=series(*velocities))
    told = (track.telemetry(round(t * S)) for t in times_s)
    views = [RecordedView("", each, None, "", lambda: None) for each in told]
    return [each.telemetry.vel_en_mps for each in with_mean_velocities(views, track)]


def test_between_distant_views_the_velocity_is_the_mean():
    """An aircraft that turned round between two views ends where it began."""
    flown = [(0, 10, 0), (1, 10, 0), (2, 0, 0), (3, -10, 0), (4, -10, 0), (5, 0, 4)]
    assert seen_at(flown, 0.5, 3.5) == [(10.0, 0.0), (0.0, 0.0)]
    mean = pytest.approx((-10 / 3, 0.0))
    assert seen_at(flown, 1, 4, 4.5, 5) == [(10.0, 0.0), mean, (-5.0, 2.0), (0.0, 4.0)]
    gap = [(0, 10, 0), (3, 10, 0), (4, 10, 0)]  # over one it is not known
    assert seen_at(gap, 0, 4) == [(10.0, 0.0), None]
    assert seen_at(gap, 3, 4, 9) == [(10.0, 0.0), (10.0, 0.0), None]
