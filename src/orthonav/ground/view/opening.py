"""Opens a run from the arguments of the command."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from orthonav.core.errors import FlightError, MissingFileError
from orthonav.core.files import with_paths
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.flight.fixes import Identity, flight_digest, read_identity
from orthonav.core.flight.mount import read_mount
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.signature import map_digest
from orthonav.core.records import ViewResult
from orthonav.ground.evaluate.truth import check_truth
from orthonav.ground.recordings.flightlog import is_flight_log
from orthonav.ground.view.feed import Feed, LineFeed
from orthonav.ground.view.images import FolderImages, NoImages, ViewImages
from orthonav.ground.view.logs import LogReader
from orthonav.ground.view.run import Run, RunLabels
from orthonav.ground.view.sheet import SheetImagery

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ViewRequest:
    """What to show: see the arguments of `orthonav view`."""

    run: Path
    map_path: Path
    second: Path | None = None
    flight: Path | None = None
    truth: Path | None = None
    mount: Path | None = None
    radius_m: float = 15.0
    live: bool = False

    def __post_init__(self) -> None:
        with_paths(self, "run", "map_path", "second", "flight", "truth", "mount")


def open_run(request: ViewRequest) -> Run:
    """The run, read as far as it exists; problems are logged.

    Raises an `OrthonavError` where a given file is missing or damaged.
    """
    if not 0 < request.radius_m < 1e7:
        raise FlightError(f"radius must be above 0 m, got {request.radius_m}")
    sheet = SheetImagery(open_map(request.map_path))
    feed = _feed(request)
    images = _images(request, feed)
    truth, truth_name = _truth(request)
    if truth:
        centre = sheet.frame.lat_deg, sheet.frame.lon_deg
        check_truth(truth, (), centre, Path(truth_name))
    labels = RunLabels(
        name=request.run.name or str(request.run),
        map_name=request.map_path.name,
        images=_images_name(request, images),
        truth=truth_name,
        live=request.live,
        second=request.second.name if request.second else "",
    )
    mount = None if request.mount is None else read_mount(request.mount)
    second = _second(request)
    run = Run(labels, feed, images, sheet, truth, request.radius_m, mount, second)
    for problem in run.problems:
        log.warning("%s", problem)
    _warn(request, run, feed, truth)
    return run


def is_log(path: Path) -> bool:
    """Whether this names a flight log, which need not exist yet."""
    if path.exists():
        return is_flight_log(path)
    return path.suffix == ".mcap"


def _feed(request: ViewRequest) -> Feed:
    path = request.run
    if request.live and not path.exists() and not path.parent.is_dir():
        raise MissingFileError(f"folder of the run does not exist: {path.parent}")
    if is_log(path) or (request.live and path.is_dir()):
        return LogReader(path, live=request.live)
    if path.is_dir():
        raise FlightError(f"expected fixes.jsonl or a flight log, got a folder without one: {path}")
    return LineFeed(path, live=request.live)


def _second(request: ViewRequest) -> Mapping[str, ViewResult] | None:
    """Results of the second run by frame, None without one; its health is not read."""
    if request.second is None:
        return None
    batch = _feed(replace(request, run=request.second, live=False)).poll()
    for problem in batch.problems:
        log.warning("%s", problem)
    if not batch.results:
        raise FlightError(f"run has no views: {request.second}")
    return {result.frame: result for result in batch.results}


def _images(request: ViewRequest, feed: Feed) -> ViewImages:
    path = request.flight
    if path is None:
        return feed if isinstance(feed, LogReader) else NoImages()
    if not path.exists() and not request.live:
        raise MissingFileError(f"flight does not exist: {path}")
    if is_log(path):
        reader = LogReader(path, live=request.live)
        reader.poll()
        return reader
    if path.is_file():
        raise FlightError(
            f"expected a flight folder or a flight log; convert other sources with `orthonav "
            f"import`: {path}"
        )
    return FolderImages(path)


def _truth(request: ViewRequest) -> tuple[Mapping[str, tuple[float, float]], str]:
    """True positions and their source: the given file, or the flight folder."""
    if request.truth is not None:
        return read_truth(request.truth), request.truth.name
    if request.flight is not None and (request.flight / "truth.csv").is_file():
        path = request.flight / "truth.csv"
        return read_truth(path), f"{request.flight.name}/{path.name}"
    return {}, ""


def _images_name(request: ViewRequest, images: ViewImages) -> str:
    if isinstance(images, NoImages):
        return ""
    return (request.flight or request.run).name


def _differences(request: ViewRequest, run: Path) -> str:
    """Which other map or flight folder than the given ones a file of fixes states; else ""."""
    if not run.is_file() or is_log(run):
        return ""
    flight = None
    if request.flight is not None and request.flight.is_dir() and not is_log(request.flight):
        flight = flight_digest(open_flight(request.flight, images_needed=False).views)
    given = Identity(map_digest(request.map_path), flight)
    return read_identity(run).differences(given, request.map_path, request.flight)


def _warn(
    request: ViewRequest, run: Run, feed: Feed, truth: Mapping[str, tuple[float, float]]
) -> None:
    """Log probable mistakes."""
    flown = feed.session.get("map") if isinstance(feed, LogReader) else None
    if isinstance(flown, dict) and flown.get("manifest_sha256") != map_digest(request.map_path):
        log.warning("the flight used another map (%.80s): %s", flown.get("name"), request.map_path)
    for path in filter(None, (request.run, request.second)):
        if other := _differences(request, path):
            log.warning("the run is of %s: %s", other, path)
    if not run.count:
        return
    if truth and not run.any_known("tx"):
        log.warning("no view of the run has a true position in %s", run.labels.truth)
    if request.second is not None and not run.any_known("x2"):
        log.warning("no view has a position in the second run: %s", request.second)
    if run.any_known("x") and not run.any_on_map():
        log.warning("no position of the run lies on this map: %s", request.map_path)
