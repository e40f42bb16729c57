"""Videos with subtitles or a table: times, dialects, and what is broken."""

import math

import numpy as np
import pytest
from recorders import (
    camera_file,
    dji_subtitle,
    hidden,
    late,
    late_by_250_ms,
    picture,
    subtitles,
    turned,
    twice_as_wide,
    video,
)

from orthonav.core.errors import CameraError, FlightError
from orthonav.core.flight import read_truth
from orthonav.ground.recordings import SourceOptions, import_flight, open_source
from orthonav.ground.recordings.subtitles import blocks


@pytest.fixture
def recorded(tmp_path):
    """Three seconds at 10 frames a second, with subtitles; its heading passes north."""
    path = video(tmp_path / "DJI_0001.mkv")
    subtitles(tmp_path / "DJI_0001.SRT", [dji_subtitle(n, yaw=355 + n) for n in range(30)])
    camera_file(tmp_path / "camera.json")
    return path


def options(path, **more):
    return SourceOptions(camera=path.parent / "camera.json", **more)


def filmed(folder, texts=None, name="a.mp4", code="mp4v", changed=lambda path: path):
    """A video of 2 s at 10 frames a second with subtitles and a camera; `changed` alters it."""
    path = changed(video(folder / name, 20, 10.0, code))
    subtitles(path.with_suffix(".srt"), texts or [dji_subtitle(n, yaw=n) for n in range(20)])
    camera_file(folder / "camera.json")
    return path


def test_views_come_at_the_rate_asked_for(recorded):
    recording = open_source(recorded, options(recorded, rate_hz=2))
    assert recording.kind == "video" and recording.expected == 6
    views = list(recording.views)
    assert [view.frame for view in views] == [f"{n:06d}.png" for n in (0, 5, 10, 15, 20, 25)]
    assert [view.telemetry.time_ns for view in views] == [n * 500_000_000 for n in range(6)]
    assert [view.telemetry.yaw_deg for view in views] == pytest.approx([355, 0, 5, 10, 15, 20])
    assert views[0].telemetry.agl_m == 120 and views[0].truth_latlon_deg == (46.5, 2.5)
    for view, number in zip(views, (0, 5, 10, 15, 20, 25), strict=True):
        assert np.abs(view.grey().astype(int) - picture(number)).max() <= 1  # by way of colours
    assert len(list(open_source(recorded, options(recorded, rate_hz=100)).views)) == 30
    assert len(list(recording.views)) == 6  # again from the first
    late = next(open_source(recorded, options(recorded, time_offset_s=0.9)).views)
    assert (late.telemetry.time_ns, late.telemetry.yaw_deg) == (900_000_000, pytest.approx(4))


@pytest.mark.parametrize("name, code", [("a.mp4", "mp4v"), ("a.avi", "MJPG"), ("a.mov", "mp4v")])
def test_other_containers(tmp_path, name, code):
    path = filmed(tmp_path, name=name, code=code)
    views = list(open_source(path, options(path)).views)
    assert [view.telemetry.time_ns for view in views] == [0, 10**9]
    assert np.abs(views[1].grey().astype(int) - picture(10)).mean() < 6


def test_a_table_beside_the_video(tmp_path):
    path = video(tmp_path / "a.mkv")
    camera_file(tmp_path / "camera.json")
    (tmp_path / "a.csv").write_text(
        "time_s,yaw_deg,pitch_deg,roll_deg,agl_m,yaw_std_deg,vel_east_mps,vel_north_mps,lat_deg,lon_deg\n"
        "0,350,1,0,100,3,5,0,46.5,2.5\n2,10,3,0,104,3,5,2,46.502,2.5\n3,10,3,0,104,,,,,\n"
    )
    views = list(open_source(path, options(path)).views)
    telemetry = views[1].telemetry
    assert (telemetry.pitch_deg, telemetry.agl_m) == pytest.approx((2, 102), abs=0.02)
    assert (telemetry.yaw_deg + 180) % 360 == pytest.approx(180, abs=0.02)
    assert telemetry.yaw_std_deg == 3 and telemetry.vel_en_mps == (5.0, 1.0)
    assert views[1].truth_latlon_deg == pytest.approx((46.501, 2.5))
    assert views[2].telemetry.agl_m == 104
    assert telemetry.tilt_std_deg == 3
    (tmp_path / "a.csv").write_text("time_s,pitch_deg,roll_deg\n0,0,0\n1,0,0\nx,0,0\n")
    with pytest.raises(FlightError, match=r"line 4: time_s"):
        open_source(path, options(path))


DIALECTS = {
    "rel_alt and gimbal": (dji_subtitle(0), (46.5, 2.5, 120.0, 402.125, 10.0, -90.0, 0.0)),
    "longtitude": (
        "[latitude : 12.5] [longtitude : -77.5] [rel_alt: 5 abs_alt: 6]",
        (12.5, -77.5, 5, 6, *[math.nan] * 3),
    ),
    "barometer": (
        "HOME(149.0251,-20.2532) 2017.08.05 14:11:51\nGPS(149.0261,-20.2533,16) BAROMETER:91.9\n"
        "ISO:100 Shutter:60 EV: Fnum:2.2",
        (-20.2533, 149.0261, 91.9, math.nan, *[math.nan] * 3),
    ),
    "latitude first, with units": (
        "2022.06.21 16:06:17\nGPS(42.5,-1.5,0.0M) BAROMETER:36.5M",
        (42.5, -1.5, 36.5, math.nan, *[math.nan] * 3),
    ),
    "old barometer": (
        "HOME(149.0251,-20.2532) 2017.8.5 14:11:51\nGPS(49.0251,-20.2533,16) Hb:1.9 Hs:2.9",
        (-20.2533, 49.0251, 1.9, math.nan, *[math.nan] * 3),
    ),
    "marks of both orders": (
        "HOME(2.5,42.5)\nGPS(2.5,42.5,0.0M) BAROMETER:36.5M",
        (math.nan, math.nan, 36.5, *[math.nan] * 4),
    ),
    "no mark": ("GPS(2.5,42.5)", (math.nan,) * 7),
    "latitude first": ("GPS(-20.25,149.5,16)", (-20.25, 149.5, *[math.nan] * 5)),
    "RTK": (
        "F/6.3, SS 60, RTK (20.083799, 30.213635, 28), HOME (20.084146, 30.214243, 103.55m), "
        "D 75.04m, H 76.19m, G.PRY (-40.0°, 0.0°, 28.2°)",
        (30.213635, 20.083799, 76.19, math.nan, 28.2, -40.0, 0.0),
    ),
    "gimbal in one line": (
        "F/2.8, SS 400, ISO 100, EV 0, DZOOM 1.0, GPS (77.6, 12.9, 21), D 80.50m, H 45.00m, "
        "H.S 3.20m/s, V.S 0.00m/s, F.PRY (1.2°, -0.5°, 88.0°), G.PRY (-60.0°, 0.5°, 90.0°)",
        (12.9, 77.6, 45.0, math.nan, 90.0, -60.0, 0.5),
    ),
    "no place on Earth": ("[latitude: 145.5] [longitude: 1.5]", (math.nan,) * 7),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_dialects(tmp_path, dialect):
    text, expected = DIALECTS[dialect]
    path = subtitles(tmp_path / "a.srt", [text, text])
    first, second = blocks(path.read_bytes())
    assert (first.start_ns, first.end_ns, second.end_ns) == (0, 10**8, 2 * 10**8)
    telemetry = (first.lat_deg, first.lon_deg, first.height_m, first.alt_m)
    telemetry += (first.yaw_deg, first.pitch_deg, first.roll_deg)
    assert telemetry == pytest.approx(expected, nan_ok=True)


def test_doubtful_positions_are_named(recorded):
    srt = recorded.with_suffix(".SRT")
    subtitles(srt, ["GPS(2.5,42.5) G.PRY (-90.0, 0.0, 10.0)"] * 30)
    (warning,) = open_source(recorded, options(recorded)).warnings
    assert "begins with the latitude or the longitude: positions are left out" in warning
    subtitles(srt, ["GPS(50.5,2.5)"] * 29 + ["GPS(50.5,102.5)"])  # of the whole file
    first = next(blocks(srt.read_bytes()))
    assert (first.lat_deg, first.lon_deg) == (50.5, 2.5)
    text = "7\r\n01:02:03,5 --> 01:02:04,000\r\n[latitude: 1.5] [longitude: 2.5]\r\n\r\n"
    (block,) = blocks(text.encode())
    assert block.start_ns == 3_723_500_000_000 and block.lat_deg == 1.5


def test_without_gimbal_angles_nothing_is_made_up(tmp_path):
    path = filmed(tmp_path, ["GPS(2.5,46.5,16) BAROMETER:91.9"] * 30)
    telemetry = next(open_source(path, options(path)).views).telemetry
    assert telemetry.missing() == ["yaw_deg", "pitch_deg", "roll_deg"] and telemetry.agl_m == 91.9
    level = next(open_source(path, options(path, looks_down=True)).views).telemetry
    assert level.missing() == ["yaw_deg"] and level.tilt_std_deg == 6


def test_a_gimbal_that_is_0_throughout_was_not_recorded(recorded):
    srt = recorded.with_suffix(".SRT")
    subtitles(srt, [dji_subtitle(n, yaw=0, pitch=0) for n in range(30)])
    recording = open_source(recorded, options(recorded))
    assert sum("of the gimbal are 0 throughout" in each for each in recording.warnings) == 1
    for telemetry in (view.telemetry for view in recording.views):
        assert telemetry.missing() == ["yaw_deg"] and telemetry.tilt_std_deg == 6
        assert (telemetry.pitch_deg, telemetry.roll_deg) == pytest.approx((0, 0), abs=1e-6)
    texts = [dji_subtitle(n, yaw=0, pitch=-90 if n else 0) for n in range(30)]
    subtitles(srt, texts)  # a gimbal that was at the horizon once
    recording = open_source(recorded, options(recorded))
    assert not any("angles are 0" in each for each in recording.warnings)
    assert {view.telemetry.tilt_std_deg for view in recording.views} == {0.5}


BROKEN = {
    "no frames": (
        lambda path, srt: path.write_bytes(path.read_bytes()[:600]),
        "no frame|opened",
    ),
    "cut": (lambda path, srt: path.write_bytes(path.read_bytes()[:-9000]), r"\d+ of 30 frames"),
    "no blocks": (lambda path, srt: srt.write_text("words\n\nand words\n"), "expected a PX4 log"),
    "endless numbers": (  # minutes for every million digits, where the search starts at each
        lambda path, srt: srt.write_text("0:00:00,0 --> G.PRY (" + "9" * 2_000_000 + "\n"),
        "hold no telemetry",
    ),
    "empty subtitles": (lambda path, srt: srt.write_bytes(b""), "telemetry log is empty"),
    "of a film": (lambda path, srt: subtitles(srt, ["- Who is it?"] * 30), "neither position nor"),
    "no subtitles": (lambda path, srt: srt.unlink(), "no telemetry beside the video"),
    "no overlap": (lambda path, srt: 60.0, "do not overlap"),
}


@pytest.mark.parametrize("how", BROKEN)
def test_damaged_video_is_one_error_and_nothing_written(recorded, tmp_path, names_in, how):
    damage, words = BROKEN[how]
    offset = damage(recorded, recorded.with_suffix(".SRT"))
    asked = options(recorded, time_offset_s=60.0 if offset == 60.0 else 0.0)
    before = names_in(tmp_path)
    with pytest.raises(FlightError, match=words) as caught:
        import_flight(open_source(recorded, asked), tmp_path / "flight")
    assert "\n" not in str(caught.value) and names_in(tmp_path) == before


def test_views_after_the_end_of_the_subtitles_have_no_telemetry(recorded, tmp_path):
    texts = [dji_subtitle(n) for n in range(12)]
    srt = subtitles(recorded.with_suffix(".SRT"), [*texts, "[latitude: 46.5] [longitude: 2.51234]"])
    srt.write_text(srt.read_text()[:-6])  # a number is cut
    recording = open_source(recorded, options(recorded, rate_hz=2.0))
    assert "telemetry ends 1.7 s before the video of 2.9 s" in recording.warnings[0]
    done = import_flight(recording, tmp_path / "flight")
    assert (done.views, done.complete, done.with_truth) == (6, 3, 3)
    assert {lon for _, lon in read_truth(tmp_path / "flight/truth.csv").values()} == {2.5}


# Zoom, edits, clocks, pixels.


@pytest.mark.parametrize(
    "form",
    ["dzoom_ratio: {:.2f}", "dzoom_ratio: {:.0f}0000, delta:0", "digital zoom {}", "DZOOM {}", ""],
)
def test_views_of_another_zoom_or_focal_length_are_left_out(recorded, form):
    """Some models write a digital zoom of 1 as 10000; a zoom of the whole flight is named."""

    def zoomed(zoom):
        texts = []
        for n in range(30):
            ratio = zoom if n >= 20 else 1
            text = f"{dji_subtitle(n)} [{form.format(ratio)}]"
            texts.append(text if form else text.replace("24.00", f"{24 * ratio}.00"))
        return texts

    subtitles(recorded.with_suffix(".SRT"), zoomed(4))
    recording = open_source(recorded, options(recorded, rate_hz=2.0))
    said = "10 of 30 subtitles state another zoom than most, the first at 2.0 s; views there"
    assert any(said in each for each in recording.warnings)
    assert [view.telemetry.time_ns / 1e9 for view in recording.views] == [0, 0.5, 1, 1.5]
    if form:
        texts = [f"{dji_subtitle(n)} [{form.format(2)}]" for n in range(30)]
        subtitles(recorded.with_suffix(".SRT"), texts)
        whole = open_source(recorded, options(recorded))
        assert "state a digital zoom of 2: --camera" in whole.warnings[0]
        assert len(list(whole.views)) == 3


SHOWN = [dji_subtitle(n, yaw=n) for n in range(15)]


def test_frames_that_edits_hide_are_not_missing(tmp_path):
    """As of a video that was cut without encoding it again; time 0 is the first frame shown."""
    path = filmed(tmp_path, SHOWN, changed=lambda path: hidden(path, begin_s=0.5, shown_s=1.5))
    recording = open_source(path, options(path, rate_hz=2.0))
    views = list(recording.views)
    assert recording.expected == 3 and "ends" not in "".join(recording.warnings)
    assert [view.telemetry.time_ns / 1e9 for view in views] == [0, 0.5, 1]
    assert [view.telemetry.yaw_deg for view in views] == pytest.approx([0, 5, 10])
    for view, number in zip(views, (5, 10, 15), strict=True):
        assert np.abs(view.grey().astype(int) - picture(number)).mean() < 6


def test_frames_that_are_missing_besides_the_hidden_ones_are_named(tmp_path):
    path = filmed(tmp_path, SHOWN, changed=lambda path: hidden(path, begin_s=0.5, shown_s=1.5))
    data = bytearray(path.read_bytes())
    end = data.index(b"moov") - 4
    begin = (data.index(b"mdat") + end) // 2
    data[begin:end] = bytes(end - begin)
    path.write_bytes(data)
    with pytest.raises(FlightError, match=r"cut short: \d of 8 frames"):
        list(open_source(path, options(path)).views)


def test_a_clock_that_begins_late_is_named(tmp_path):
    """Time 0 is the first frame."""
    path = filmed(tmp_path, changed=lambda path: late(path, by_s=2.5))
    recording = open_source(path, options(path))
    assert "begins at 2.5 s; time 0 is its first frame" in recording.warnings[0]
    views = list(recording.views)
    assert recording.expected == len(views) == 2
    assert [view.telemetry.yaw_deg for view in views] == pytest.approx([0, 10])


def test_the_time_before_the_first_frame_holds_no_missing_frames(recorded):
    late_by_250_ms(recorded)
    recording = open_source(recorded, options(recorded))
    assert recording.expected == len(list(recording.views)) == 3


def test_pixels_that_are_not_square(recorded):
    twice_as_wide(recorded)
    said = r"2\.000 times as wide as high, those of the camera 1\.0"
    with pytest.raises(CameraError, match=said):
        open_source(recorded, options(recorded))
    camera_file(recorded.parent / "camera.json", fx_px=30.0, unusual=True)
    assert open_source(recorded, options(recorded)).camera.fx_px == 30


def test_a_video_that_players_turn_is_used_as_stored(tmp_path):
    path = filmed(tmp_path, changed=turned)
    recording = open_source(path, options(path))
    said = "players show the video turned by 180 deg; its frames are used as stored"
    assert said in recording.warnings[0]
    assert np.abs(next(recording.views).grey().astype(int) - picture(0)).mean() < 6


def test_of_subtitles_and_a_table_the_subtitles_are_used_and_named(recorded):
    recorded.with_suffix(".csv").write_text("time_s,pitch_deg,roll_deg\n0,0,0\n3,0,0\n")
    recording = open_source(recorded, options(recorded))
    assert recording.choices[0].startswith("telemetry: using DJI_0001.SRT, not DJI_0001.csv: ")
    assert next(recording.views).telemetry.yaw_deg == pytest.approx(355)
