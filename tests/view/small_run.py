"""A small run over a known ground: map, flight, fixes right and wrong; and a server of a run."""

import csv
import json
import threading
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from blots import CAMERA, GROUND, as_grey, rendered

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.mapfile import Manifest, SheetInfo, write_map
from orthonav.core.mapfile.manifest import TerrainInfo
from orthonav.core.mapfile.terrain import SURFACE, TERRAIN, encode_terrain, terrain_part_names
from orthonav.core.records import Fix, NoFix, ViewResult
from orthonav.ground.build.layer import GreyLayerWriter
from orthonav.ground.view.server import Pages, Server, load_assets

FRAME = LocalFrame(46.5, 2.5)
WEST_M, NORTH_M, GSD_M = -180.0, 160.0, 0.5
HEIGHTS_FROM = WEST_M, NORTH_M, 1.0
HEIGHT_PX, WIDTH_PX, CHUNK_PX = 620, 700, 256
AGL_M = 60.0
COV_EN_M2 = np.array([[9.0, 4.0], [4.0, 16.0]])
PLACES_EN_M = [(-60.0, 20.0), (-30.0, 25.0), (0.0, 30.0), (30.0, 25.0), (60.0, 20.0), (80.0, 0.0)]
ATTITUDES = [(40.0 + 10 * i, 4.0, -3.0) for i in range(len(PLACES_EN_M))]
WRONG, NO_FIX = 3, 4
"""Of the views one is confident and 60 m off, one has no fix."""


def name(i):
    return f"view {i:02d}.png"


def plane(height, width, level=0):
    """East and north (height, width) of the pixels of a level."""
    cols, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    step_m = GSD_M * 2**level
    return WEST_M + cols * step_m, NORTH_M - rows * step_m


def write_small_map(path, *, layer=True, ground=GROUND, heights=()):
    """A ground as a map; its south-east corner shows nothing. `heights`: terrain (and surface)
    every metre (H, W) from the corner of the map."""
    grey = as_grey(ground(*plane(HEIGHT_PX, WIDTH_PX)))
    valid = np.ones(grey.shape, bool)
    valid[-100:, -150:] = False
    grid = TileGrid(WEST_M, NORTH_M, GSD_M, 100, 20, 27, 31)
    assert (grid.height_px, grid.width_px) == grey.shape
    info, parts = None, {}
    if layer:
        writer = GreyLayerWriter(*grey.shape, chunk_px=CHUNK_PX)
        writer.add(0, 0, np.where(valid, grey, 0).astype(np.uint8), valid)
        info, parts = writer.finish()
    infos = {}
    for name, values in zip((TERRAIN, SURFACE), heights, strict=False):
        limits = float(np.nanmin(values)), float(np.nanmax(values)), 0.05
        known = int(np.isfinite(values).sum())
        infos[name] = TerrainInfo(*HEIGHTS_FROM, *values.shape, 1024, *limits, known, name, "msl")
        data = np.frombuffer(encode_terrain(values, infos[name]), np.uint8)
        names = terrain_part_names(0, name)
        parts |= zip(names, (data, np.array([0, len(data)])), strict=True)
    small = cv2.resize(grey, (350, 310), interpolation=cv2.INTER_AREA)
    manifest = Manifest(
        recipe={"method": "gradient"},
        sheets=(SheetInfo(FRAME, grid, 27 * 31, 0.08, info, **infos),),
        imagery=(),
        view={"heading_step_deg": 6.0, "min_valid_share": 0.4, "position_std_m": 7.0},
        confidence=None,
        radius_m=24.0,
        created_by="test",
    )
    arrays = {
        "sheet0/centres_en_m": np.zeros((27 * 31, 2), np.float32),
        "sheet0/embeddings": np.zeros((27 * 31, 4), np.float16),
        "sheet0/preview_jpeg": np.frombuffer(cv2.imencode(".jpg", small)[1].tobytes(), np.uint8),
    }
    write_map(path, manifest, {**arrays, **parts})
    return path


def write_small_flight(folder):
    """Views of the ground, with exact telemetry, and their truth."""
    (folder / "frames").mkdir(parents=True)
    with (folder / "telemetry.csv").open("w", newline="") as telemetry:
        rows = csv.writer(telemetry)
        rows.writerow(["frame", "time_s", "yaw_deg", "pitch_deg", "roll_deg", "agl_m"])
        for i, (place, attitude) in enumerate(zip(PLACES_EN_M, ATTITUDES, strict=True)):
            view = rendered(GROUND, place, attitude, AGL_M)
            cv2.imwrite(str(folder / "frames" / name(i)), view)
            rows.writerow([name(i), 100 + i, *attitude, AGL_M])
    with (folder / "truth.csv").open("w", newline="") as truth:
        rows = csv.writer(truth)
        rows.writerow(["frame", "lat_deg", "lon_deg"])
        for i, place in enumerate(PLACES_EN_M):
            rows.writerow([name(i), *(repr(float(v)) for v in FRAME.latlon_from_en(place))])
    camera = {key: value for key, value in vars(CAMERA).items() if key != "distortion"}
    (folder / "flight.json").write_text(json.dumps({"camera": camera}))
    return folder


def result(i, state="tracking"):
    """What came out for view `i`."""
    if i == NO_FIX:
        outcome = NoFix("blank", "there is nothing to see")
    else:
        east, north = PLACES_EN_M[i]
        lat, lon = FRAME.latlon_from_en((east - 60.0 * (i == WRONG), north))
        heading_deg = ATTITUDES[i][0]
        outcome = Fix(
            *(float(lat), float(lon), COV_EN_M2, 0.95, 35.0, heading_deg, AGL_M), {"score": 0.5}
        )
    return ViewResult(name(i), (100 + i) * 10**9, outcome, 12.5, state)


class Small(NamedTuple):
    """Where the run lies."""

    map_path: Path
    flight: Path
    fixes: Path


@contextmanager
def serving(run):
    """A server of a run on a port of its own."""
    with Server(Pages(run, load_assets())) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
