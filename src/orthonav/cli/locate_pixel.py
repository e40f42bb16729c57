"""`orthonav locate-pixel`: where on the ground a pixel of a placed view lies."""

import argparse
import contextlib
import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING

import orthonav
from orthonav.cli.common import add_options, print_result
from orthonav.core.errors import FlightError, MissingFileError, OrthonavError

if TYPE_CHECKING:
    from orthonav.core.flight import RecordedView
    from orthonav.core.mapfile.terrain import TerrainLayer

EXAMPLE = "fixes.jsonl 0001.jpg 640 480 --flight flight"
log = logging.getLogger(__name__)


def add(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "the 95 % ellipse excludes errors of the terrain, buildings and trees"
    add = parser.add_argument
    text = "fixes, as written by `orthonav localize`"
    add("fixes", type=Path, metavar="fixes.jsonl", help=text)
    add("frame", metavar="FRAME", help="name of the view, as in the file")
    add("x", type=float, metavar="X", help="pixels from the left border, as stored")
    add("y", type=float, metavar="Y", help="pixels from the upper border, as stored")
    text = "flight folder that was localized, for camera, pitch and roll"
    add("--flight", type=Path, required=True, metavar="FLIGHT_DIR", help=text)
    text = "map of the flight, whose terrain is the ground (default: level ground)"
    add("--map", type=Path, metavar="MAP.onav", help=text)
    add_options(parser, "--mount", "--json")


def run(options: argparse.Namespace) -> None:
    from orthonav.core.flight.fixes import Identity, flight_digest, read_identity
    from orthonav.core.flight.mount import read_mount
    from orthonav.ground.recordings.pixel import ellipse_95, locate_pixel

    results = {each.frame: each for each in orthonav.read_results(options.fixes)}
    if options.frame not in results and Path(options.frame).name in results:
        options.frame = Path(options.frame).name  # the path of an image
    result = results.get(options.frame)
    if result is None:
        raise FlightError(f"there is no view {options.frame!r}: {options.fixes}")
    fix = result.outcome
    if not isinstance(fix, orthonav.Fix):
        raise FlightError(f"view {options.frame!r} has no position ({fix.reason})")
    flight = orthonav.open_flight(options.flight, images_needed=False)
    view = next((each for each in flight.views if each.frame == options.frame), None)
    if view is None:
        raise FlightError(f"there is no view {options.frame!r}: {options.flight}")
    telemetry = view.telemetry
    if options.mount is not None:
        telemetry = read_mount(options.mount).corrected(telemetry)
    terrain, used = (None, None) if options.map is None else _terrain(options.map)
    given = Identity(used, flight_digest(flight.views))
    other = read_identity(options.fixes).differences(given, options.map, options.flight)
    if other:
        log.warning("fixes are of %s: %s", other, options.fixes)
    turned = _is_turned(Path(view.where))
    found = locate_pixel(_camera(flight, view), telemetry, fix, (options.x, options.y), terrain)
    is_above_sea = terrain is not None and terrain.info.is_above_sea
    height_m = found.height_m if is_above_sea else math.nan
    ellipse = ellipse_95(found.cov_en_m2)
    plain = {
        "lat_deg": round(found.lat_deg, 9),
        "lon_deg": round(found.lon_deg, 9),
        "height_m": None if math.isnan(height_m) else round(height_m, 2),
        "range_m": round(found.range_m, 2),
        "cov_en_m2": found.cov_en_m2.tolist(),
        "ellipse_95": ellipse,
        "confident": result.is_confident,
        "shown_turned": turned,
    }
    above = "" if math.isnan(height_m) else f", {height_m:.1f} m above sea"
    axes = "unknown"
    if ellipse is not None:
        axes = f"{ellipse['major_m']:.1f} x {ellipse['minor_m']:.1f} m, major axis at "
        axes += f"{ellipse['direction_deg']:.0f} deg"
    guess = [] if result.is_confident else ["! the position of this view is a best guess"]
    print_result(
        options,
        plain,
        f"{found.lat_deg:.8f}, {found.lon_deg:.8f}{above}",
        f"95 % ellipse {axes}; {found.range_m:.0f} m from the camera",
        *guess,
    )


def _is_turned(path: Path) -> bool:
    from orthonav.ground.recordings.exif import read_photo

    turned = False
    with contextlib.suppress(OrthonavError):
        turned = read_photo(path).turned
    if turned:
        log.warning("X and Y count as stored; other programs show it turned, by EXIF: %s", path)
    return turned


def _camera(flight: "orthonav.FlightFolder", view: "RecordedView") -> "orthonav.Camera":
    """The camera at the size of the image of a view; as calibrated where that cannot be read."""
    try:
        height_px, width_px = view.grey().shape
    except (FlightError, MissingFileError):
        return flight.camera
    return flight.camera.fitted(width_px, height_px)


def _terrain(path: Path) -> "tuple[TerrainLayer, str]":
    from orthonav.core.mapfile.terrain import TerrainLayer

    opened = orthonav.open_map(path)
    terrain = TerrainLayer.of(opened)
    if terrain is None:
        raise FlightError(f"the map has no terrain: {path}")
    return terrain, opened.manifest.sha256
