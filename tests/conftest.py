"""What many tests share: a generated area at two dates, a map of it, a flight over it."""

import fcntl
import gc
import logging
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

# Before NumPy and PyTorch are loaded: tests run side by side.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
# As the program does: FFmpeg reads it once, and otherwise writes lines of its own to stderr.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**28))

# A run starts many processes. Without bytecode each one compiles the tests and the program again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import cv2
import hypothesis
import pytest

from helpers import Done, textured
from orthonav.cli import main
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.geo.camera import Camera
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map

pytest_plugins = ["absent"]
SEED = 2
# Nothing that tests write has to outlive the machine. A file that is closed is still an error.
os.fsync = os.fstat
cv2.setNumThreads(1)  # tests run side by side
gc.set_threshold(20_000, 20, 50)  # of many small objects; the garbage of tests is little
# A slow or busy machine fails no test: the time limit of a whole test is in pyproject.toml. The
# same examples in every run: what passed in one clone passes in the next.
hypothesis.settings.register_profile("orthonav", deadline=None, max_examples=30, derandomize=True)
hypothesis.settings.load_profile("orthonav")


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Modules and tests live until the end: the garbage collector need not look at them."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


LONGEST = (
    "test_cli.py",
    "test_in_browser.py",
    "test_ros2_graph.py",
    "test_demo.py",
    "test_check_command.py",
    "test_tracker.py",
    "test_platforms.py",
    "test_check_page.py",
    "test_build.py",
    "test_fly.py",
    "test_mixture.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files come first: at the end, one of them would run alone."""
    rank = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(LONGEST)))


@dataclass(frozen=True)
class SmallArea:
    """A generated area: one orthophoto per date, a camera whose views at `agl_m` fill a tile."""

    past: Path
    present: Path
    camera: Camera
    agl_m: float


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    """Function that gives a folder which `make` fills, once for all processes that run tests."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent

    def made(name, make):
        folder, done = root / f"{name}-of-all", root / f"{name}-done"
        with (root / f"{name}-lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)  # of one that failed
                folder.mkdir()
                make(folder)
                done.touch()
        return folder

    return made


@pytest.fixture(scope="session")
def area(made_once):
    """Orthophotos of 1.2 x 1.0 km at 1 m, of two dates; not to be changed."""

    from lab.landscape import DEFAULT_DATES, generate_area

    def make(folder):
        generate_area(folder, size_m=(1200.0, 1000.0), dates=DEFAULT_DATES[:2], seed=SEED)

    dates = sorted(made_once("area", make).iterdir())
    return SmallArea(*dates, camera=Camera(320, 240, 250.0, 250.0, 160.0, 120.0), agl_m=375.0)


@pytest.fixture(scope="session")
def map_path(area, made_once):
    """A map of the first date: tiles of 128 px of 2.5 m; not to be changed."""

    from orthonav.ground.build import BuildRequest, build_map

    def make(folder):
        out = folder / "area.onav"
        build_map(BuildRequest([area.past], out, tile_px=128, gsd_m=2.5, calibration_views=14))

    return made_once("map", make) / "area.onav"


@pytest.fixture(scope="session")
def localizer(map_path):
    """A localizer on that map that searches tiles only."""
    return Localizer(open_map(map_path), registration=False)


@pytest.fixture(scope="session")
def flight_path(area, made_once):
    """A flight of 30 views of the second date, with errors and no prior; not to be changed."""

    from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight

    def make(folder):
        errors = Errors(yaw_std_deg=4.0, agl_std=0.03, attitude_std_deg=3.0)
        flown = {"agl_m": area.agl_m, "camera": area.camera, "errors": errors, "seed": SEED}
        simulate_flight(SimulateRequest([area.present], folder / "flight", random=30, **flown))

    return made_once("flight", make) / "flight"


@pytest.fixture(scope="session")
def flight(flight_path):
    """That flight, opened."""
    return open_flight(flight_path)


@pytest.fixture(scope="session")
def truth_en_m(flight_path, localizer):
    """True places of its views by frame, metres east and north in the plane of the map."""
    truth = read_truth(flight_path / "truth.csv")
    return {name: localizer.sheet.frame.en_from_latlon(*latlon) for name, latlon in truth.items()}


@pytest.fixture(scope="session")
def make_ortho():
    """Function that writes a picture (H, W) as an orthophoto in Lambert-93, 1 m a pixel."""
    import numpy as np
    import rasterio
    from rasterio.transform import Affine

    def write(path, grey=None, crs="EPSG:2154", nodata=None, gsd_m=1.0):
        grey = textured() if grey is None else grey
        corner = Affine(gsd_m, 0, 700_000, 0, -gsd_m, 6_600_000)
        shape = dict(zip(("height", "width"), grey.shape, strict=True))
        shape["count"] = 1 if len(np.unique(grey)) > 30 else 3  # few values in one are a mask
        about = {"driver": "GTiff", "dtype": "uint8", "crs": crs, "nodata": nodata, **shape}
        with rasterio.open(path, "w", transform=corner, **about) as data:
            data.write(np.broadcast_to(grey, (shape["count"], *grey.shape)))
        return Path(path)

    return write


@pytest.fixture(scope="session")
def names_in():
    """Function that lists everything below a folder, hidden temporaries included."""

    def names(folder):
        return sorted(str(path.relative_to(folder)) for path in Path(folder).rglob("*"))

    return names


@pytest.fixture
def run(capfd, monkeypatch):
    """Function that runs a command in this process as a fresh one would."""
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    root = logging.getLogger()

    def command(*arguments):
        handlers, root.handlers, level = root.handlers, [], root.level
        capfd.readouterr()
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as left:
            code = left.code
        finally:
            root.handlers = handlers
            root.setLevel(level)
        captured = capfd.readouterr()
        return Done(code, captured.out, captured.err)

    return command
