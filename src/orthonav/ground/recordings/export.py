"""Camera positions of a flight for other programs: tables, maps, photogrammetry, trajectories.

Only confident positions are written: photogrammetry takes what it is given as measured.
"""

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from scipy.spatial.transform import Rotation

from orthonav.core.errors import VariantError
from orthonav.core.files import write_text
from orthonav.core.geo.camera import enu_from_camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.ground import TerrainHeights
from orthonav.core.records import MAP_STD_M, Fix, ViewResult

_XML = '<?xml version="1.0" encoding="UTF-8"?>\n'
_YEAR_2000_NS = 946_684_800 * 10**9  # earlier times count from something else than 1970
CSV_COLUMNS = ("frame", "lat_deg", "lon_deg", "height_m", "agl_m", "heading_deg", "std_m")


@dataclass(frozen=True, eq=False)
class CameraPosition:
    """Where a picture was taken: a view and its confident fix.

    `height_m`: above mean sea level, NaN without a terrain. `std_m`: standard deviation of the
    position along its worst axis, the displacement of the map included.
    """

    view: ViewResult
    fix: Fix
    height_m: float
    std_m: float


def camera_positions(
    results: Sequence[ViewResult], terrain: TerrainHeights | None
) -> list[CameraPosition]:
    """The confident positions of a flight; heights above sea by the ground of `terrain`."""
    found = []
    for view in results:
        fix = view.outcome
        if not isinstance(fix, Fix) or not view.is_confident:
            continue
        ground_m = math.nan
        if terrain is not None:
            ground_m = float(terrain(np.array([fix.lat_deg]), np.array([fix.lon_deg]))[0])
        worst = max(float(np.linalg.eigvalsh(fix.cov_en_m2)[-1]), 0.0)
        if view.state is None:  # that of a track has it already
            worst += MAP_STD_M**2
        found.append(CameraPosition(view, fix, ground_m + fix.agl_m, math.sqrt(worst)))
    return found


def export_of(text: str) -> tuple[str, Path]:
    name, _, path = text.partition("=")
    if name not in FORMATS or not path:
        raise VariantError(
            f"an export is one of {', '.join(FORMATS)} with a path, such as odm-geo=geo.txt, "
            f"got '{text}'"
        )
    return name, Path(path)


def export_all(
    exports: Sequence[tuple[str, Path]],
    results: Sequence[ViewResult],
    terrain: TerrainHeights | None,
) -> None:
    """Write the camera positions of a flight in formats and to paths of `export_of`."""
    positions = camera_positions(results, terrain) if exports else []
    for name, path in exports:
        write_text(path, FORMATS[name](positions))


def _fixed(value: float, decimals: int = 3) -> str:
    return "" if math.isnan(value) else f"{value:.{decimals}f}"


def _csv(positions: Sequence[CameraPosition]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for each in positions:
        place = _fixed(each.fix.lat_deg, 8), _fixed(each.fix.lon_deg, 8)
        values = each.height_m, each.fix.agl_m, each.fix.heading_deg, each.std_m
        writer.writerow([each.view.frame, *place, *map(_fixed, values)])
    return out.getvalue()


def _odm_geo(positions: Sequence[CameraPosition]) -> str:
    """OpenDroneMap's image geolocation file, https://docs.opendronemap.org/geo.

    Accuracy follows angles, and angles follow the height: without a height it is left out. Angles
    are 0, which means not available. Names must have no spaces.
    """
    lines = ["EPSG:4326"]
    for each in positions:
        if any(character.isspace() for character in each.view.frame):
            raise VariantError(f"OpenDroneMap takes no file names with spaces: {each.view.frame!r}")
        line = f"{each.view.frame} {each.fix.lon_deg:.8f} {each.fix.lat_deg:.8f}"
        if not math.isnan(each.height_m):
            line += f" {each.height_m:.3f} 0 0 0 {each.std_m:.3f}"
        lines.append(line)
    return "\n".join(lines) + "\n"


def _tum(positions: Sequence[CameraPosition]) -> str:
    """A trajectory as evo reads it: `timestamp tx ty tz qx qy qz qw`, metres and a quaternion.

    East, north and up of the first position; the quaternion turns camera axes (x to the right of
    the image, y down the image, z along the optical axis) to these. Unknown angles count as 0.
    Heights are above sea where all are known, else above ground.
    """
    if not positions:
        return ""
    origin = positions[0].fix.lat_deg, positions[0].fix.lon_deg
    plane, above_sea = LocalFrame(*origin), all(math.isfinite(each.height_m) for each in positions)
    lines = [f"# east, north, up (m) of {origin[0]:.8f}, {origin[1]:.8f} (WGS84)"]
    for each in positions:
        east, north = plane.en_from_latlon(each.fix.lat_deg, each.fix.lon_deg).tolist()
        up = each.height_m if above_sea else each.fix.agl_m
        angles = np.nan_to_num([each.fix.heading_deg, each.fix.pitch_deg, each.fix.roll_deg])
        rotation = Rotation.from_matrix(enu_from_camera(*angles.tolist()))
        numbers = " ".join(f"{value:.9f}" for value in rotation.as_quat(canonical=True))
        lines.append(
            f"{Decimal(each.view.time_ns).scaleb(-9):f} {east:.4f} {north:.4f} {up:.4f} {numbers}"
        )
    return "\n".join(lines) + "\n"


def _kml(positions: Sequence[CameraPosition]) -> str:
    """The track and a place for each picture; heights are absolute where all are above sea."""
    above_sea = all(math.isfinite(each.height_m) for each in positions)
    mode = "absolute" if above_sea else "relativeToGround"
    heights_m = [each.height_m if above_sea else each.fix.agl_m for each in positions]
    points = [
        f"{each.fix.lon_deg:.8f},{each.fix.lat_deg:.8f},{height_m:.2f}"
        for each, height_m in zip(positions, heights_m, strict=True)
    ]

    def placemark(name: str, about: str, kind: str, coordinates: str) -> str:
        return (
            f"<Placemark><name>{escape(name)}</name><description>{about}</description>"
            f"<{kind}><altitudeMode>{mode}</altitudeMode><coordinates>{coordinates}</coordinates>"
            f"</{kind}></Placemark>"
        )

    marks = [placemark("track", f"{len(points)} positions", "LineString", " ".join(points))]
    marks += [
        placemark(each.view.frame, f"std {each.std_m:.1f} m", "Point", point)
        for each, point in zip(positions, points, strict=True)
    ]
    body = "\n".join(marks)
    return (
        f'{_XML}<kml xmlns="http://www.opengis.net/kml/2.2"><Document>\n{body}\n</Document></kml>\n'
    )


def _gpx(positions: Sequence[CameraPosition]) -> str:
    """A track (GPX 1.1); with heights above sea where known, and times that are dates."""
    lines = []
    for each in positions:
        height = f"<ele>{each.height_m:.2f}</ele>" if math.isfinite(each.height_m) else ""
        time = ""
        if each.view.time_ns >= _YEAR_2000_NS:
            seconds = datetime.fromtimestamp(each.view.time_ns // 10**9, UTC).strftime(
                "%Y-%m-%dT%H:%M:%S"
            )
            time = f"<time>{seconds}.{each.view.time_ns % 10**9 // 10**6:03d}Z</time>"
        place = f'lat="{each.fix.lat_deg:.8f}" lon="{each.fix.lon_deg:.8f}"'
        lines.append(f"<trkpt {place}>{height}{time}<name>{escape(each.view.frame)}</name></trkpt>")
    body = "\n".join(lines)
    return (
        f'{_XML}<gpx version="1.1" creator="orthonav" xmlns="http://www.topografix.com/GPX/1/1">'
        f"<trk><trkseg>\n{body}\n</trkseg></trk></gpx>\n"
    )


FORMATS: dict[str, Callable[[Sequence[CameraPosition]], str]] = {
    "csv": _csv,
    "odm-geo": _odm_geo,
    "tum": _tum,
    "kml": _kml,
    "gpx": _gpx,
}
"""Writers by the name of their format."""
