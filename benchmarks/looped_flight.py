"""Looped flights played in real time: one lap is rendered, cached and repeated."""

import csv
import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from orthonav.core.flight import read_truth
from orthonav.core.geo import camera
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.planning.route import Route
from orthonav.ground.simulate import render
from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight

CAMERA = Camera(
    1280, 960, 1000.0, 1000.0, 646.0, 474.0, distortion=(-0.12, 0.05, 0.0005, -0.0003, 0.0)
)
"""A wide board camera: 65 x 51 deg, and a lens that bends the rim by 17 px."""
AGL_M, SPEED_MPS = 250.0, 25.0
HALF_M, TURN_RADIUS_M = 300.0, 120.0
LINE_EN_M = ((0, 1), (1, 1), (1, -1), (-1, -1), (-1, 1), (0, 1))
"""Corners of a lap in `HALF_M` from the middle of the map; it ends where it begins."""
SEED = 7
ERRORS = Errors(
    yaw_std_deg=0.5,
    agl_std=0.01,
    tilt_std_deg=1.0,
    yaw_bias_deg=3.0,
    agl_bias=0.03,
    pitch_bias_deg=0.5,
    velocity_drift=0.02,
)

Array = NDArray[np.float64]


def rendered(
    work: Path, ortho: Path, frame: LocalFrame, rate_hz: float, short: bool = False
) -> Path:
    """Flight folder of a lap at so many views a second, rendered once; short: a side and a half."""
    folder = work / f"lap-{rate_hz:g}-hz{'-short' * short}"
    if not folder.is_dir():
        lat, lon = frame.latlon_from_en(np.array(LINE_EN_M[-3:] if short else LINE_EN_M) * HALF_M)
        request = SimulateRequest(
            [ortho],
            folder,
            route=Route(tuple(zip(lat.tolist(), lon.tolist(), strict=True))),
            agl_m=AGL_M,
            spacing_m=SPEED_MPS / rate_hz,
            airspeed_mps=SPEED_MPS,
            camera=CAMERA,
            errors=ERRORS,
            seed=SEED,
            turn_radius_m=TURN_RADIUS_M,
        )
        with patch.object(render, "undistort", _kept(camera.undistort)):
            simulate_flight(request)
    return folder


def _kept(undistort: Callable[[Camera, Array], Array]) -> Callable[[Camera, Array], Array]:
    """The lens undone for all pixels takes seconds, and is the same for every view."""
    found: dict[tuple[Camera, int], Array] = {}

    def once(camera: Camera, xy: Array) -> Array:
        key = camera, len(xy)
        if key not in found:
            found[key] = undistort(camera, xy)
        return found[key]

    return once


def played(
    lap: Path, out: Path, views: int, *, every: int = 1, first: int = 0, lead_s: float = 0.0
) -> Path:
    """A flight folder of so many views of a lap, `every` so many, round and round.

    It begins with view `first`, at `lead_s`. Its pictures are those of the lap, under a name for
    each round, so an hour takes no more room than a lap.
    """
    rows, truth = read_rows(lap / "telemetry.csv"), read_rows(lap / "truth.csv")
    times_s = np.array([float(row["time_s"]) for row in rows])
    period_s = float(times_s[-1]) + _closing_m(lap) / SPEED_MPS
    shutil.rmtree(out, ignore_errors=True)
    (out / "frames").mkdir(parents=True)
    telemetry, true = [], []
    for number in range(views):
        turn, index = divmod(first + number * every, len(rows))
        frame = f"{turn:04d}/{rows[index]['frame']}"
        time_s = lead_s + turn * period_s + float(times_s[index] - times_s[first])
        telemetry.append({**rows[index], "frame": frame, "time_s": f"{time_s:.9f}"})
        true.append({**truth[index], "frame": frame})
        link = out / "frames" / f"{turn:04d}"
        if not link.is_symlink():
            link.symlink_to((lap / "frames").resolve(), target_is_directory=True)
    write_rows(out / "telemetry.csv", telemetry)
    write_rows(out / "truth.csv", true)
    shutil.copyfile(lap / "flight.json", out / "flight.json")
    return out


def rest_of(folder: Path, out: Path, from_s: float) -> Path:
    """The views of a played flight from a time on, as from a camera that starts then."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    rows = [row for row in read_rows(folder / "telemetry.csv") if float(row["time_s"]) >= from_s]
    write_rows(out / "telemetry.csv", rows)
    shutil.copyfile(folder / "flight.json", out / "flight.json")
    (out / "frames").symlink_to((folder / "frames").resolve(), target_is_directory=True)
    return out


def read_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a table with a header, as text."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def write_rows(path: Path, rows: Sequence[dict[str, str]]) -> None:
    """Write what `read_rows` reads."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _closing_m(lap: Path) -> float:
    """From the last view of a lap to its first."""
    places = list(read_truth(lap / "truth.csv").values())
    last = LocalFrame(*places[0]).en_from_latlon(*places[-1])
    return math.hypot(*last.tolist())
