"""What many tests import. Not in `conftest.py`: any folder may have one of its own."""

import contextlib
import csv
import functools
import time
import tracemalloc
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np


def textured(shape=(400, 400), seed=0):
    """A picture (H, W) uint8 of blots of many sizes, unlike itself everywhere."""
    return _textured(tuple(shape), seed).copy()


@functools.lru_cache(maxsize=16)
def _textured(shape, seed):
    rng = np.random.default_rng(seed)
    total = np.zeros(shape, dtype=np.float32)
    for sigma in (1.5, 4.0, 12.0):
        blots = cv2.GaussianBlur(rng.normal(size=shape).astype(np.float32), (0, 0), sigma)
        total += (blots / blots.std()).reshape(shape)
    return np.clip(128 + 32 * total, 1, 255).astype(np.uint8)


@contextlib.contextmanager
def memory_below(limit_bytes):
    """Fails where Python's own memory grows by more."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < limit_bytes
    finally:
        tracemalloc.stop()


def shorten(flight, views):
    """Leave all but the first views out of the tables of a flight folder."""
    for name in ("telemetry.csv", "truth.csv"):
        lines = (flight / name).read_text().splitlines(keepends=True)
        (flight / name).write_text("".join(lines[: views + 1]))
    return flight


def change_rows(path, change):
    """Let `change` alter every row of a CSV table, a dictionary, by its number from 0."""
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for number, row in enumerate(rows):
        change(number, row)
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


class Done(NamedTuple):
    """What a command gave: exit code, stdout and stderr, those of C libraries included."""

    code: int
    out: str
    err: str


def refused(done, *words, code=1):
    """Check for exactly one line on stderr, nothing on stdout, and the exit code: 2 where the
    command has to be typed otherwise, whatever the input."""
    assert (done.code, done.out) == (code, ""), done
    assert done.err.startswith("orthonav: error: ") and done.err.endswith("\n"), done
    assert done.err.count("\n") == 1 and "Traceback" not in done.err, done
    assert all(word in done.err for word in words), (words, done)


def write_dem(path, frame, height_of, half_m=1500.0, px_m=25.0, change=lambda heights: heights):
    """A terrain model in the plane of `frame`: `height_of` east and north (m), above the sea.

    It does not state its datum. `change` alters the heights (H, W) before they are written.
    """
    import rasterio
    from rasterio.transform import Affine

    side = round(2 * half_m / px_m)
    centres = (np.arange(side) + 0.5) * px_m - half_m
    heights = change(height_of(centres[None, :], -centres[:, None]).astype(np.float32))
    with rasterio.open(
        path, "w", driver="GTiff", count=1, height=side, width=side, dtype="float32",
        crs=frame.proj4, transform=Affine(px_m, 0, -half_m, 0, -px_m, half_m), nodata=-9999,
    ) as data:  # fmt: skip
        data.write(heights[None])
    return path


def waypoints(frame, points_en_m):
    """Latitude and longitude of points (N, 2) of a plane, as pairs."""
    places = frame.latlon_from_en(np.asarray(points_en_m, float))
    return tuple(zip(*(each.tolist() for each in places), strict=True))


def box_deg(frame, west_m, south_m, east_m, north_m):
    """West, south, east, north in degrees of a box in a plane."""
    (south, west), (north, east) = waypoints(frame, [[west_m, south_m], [east_m, north_m]])
    return west, south, east, north


def content(folder):
    """The bytes of all files below a folder, by name."""
    paths = sorted(path for path in Path(folder).rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


LONGEST_S = 240.0
"""Only what hangs takes so long."""


def wait_for(condition, why="", process=None):
    """What the condition gives, once that is true; an assertion where it never is.

    `why`: a text, or what gives one. If `process` ends before that, the wait fails at once with
    what it wrote to its stderr (a pipe), else with `why`.
    """
    deadline, ended = time.monotonic() + LONGEST_S, False
    while time.monotonic() < deadline and not ended:
        ended = process is not None and process.poll() is not None
        found = condition()  # also of what it did last
        if found:
            return found
        time.sleep(0.01)
    said = why() if callable(why) else why
    if ended:
        said = process.stderr.read() if process.stderr else said
        raise AssertionError(f"the process ended with {process.returncode}: {said}")
    raise AssertionError(f"not within {LONGEST_S} s: {said or condition}")
