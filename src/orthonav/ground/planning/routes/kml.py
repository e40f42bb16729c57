"""Routes as KML (OGC 07-147r2, and Google's gx:Track) and KMZ, which is KML in a zip archive."""

import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from io import BytesIO
from xml.etree.ElementTree import Element

from orthonav.core.errors import RouteError
from orthonav.ground.planning.routes.markup import read_markup, text_of
from orthonav.ground.planning.routes.record import Height, HeightFrame, Route, require_few_waypoints
from orthonav.ground.planning.routes.values import numbers_in, parsed
from orthonav.ground.planning.routes.wpml import read_wpml

MAX_KML_BYTES = 20_000_000
MAX_MEMBERS = 10_000
_HEIGHT_FRAMES: dict[str, HeightFrame] = {"absolute": "amsl", "relativeToGround": "agl"}
"""With other altitude modes, or none, the altitude is ignored, as KML specifies."""
_POINTLESS = ("Point", "Polygon", "LinearRing", "Model")
_END = struct.Struct("<4s4H2LH")
_Place = tuple[float, float, Height | None]


def read_kmz(data: bytes) -> list[Route]:
    """Lines and tracks of the archive's `doc.kml`, else of its only KML file; of a mission of DJI
    its waylines.

    Raises `RouteError`, also on archives that would unpack to more than `MAX_KML_BYTES`.
    """
    _check_archive(data)
    try:
        with zipfile.ZipFile(BytesIO(data)) as archive:
            chosen = _chosen_members(archive.namelist())
            if len(chosen) != 1:
                raise RouteError(f"KMZ must hold one KML file, got {len(chosen)}")
            with archive.open(chosen[0]) as member:
                text = member.read(MAX_KML_BYTES + 1)
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError) as error:
        raise RouteError(f"KMZ is not a complete zip archive ({error})") from error
    except (NotImplementedError, RuntimeError, ValueError) as error:  # encrypted, odd compression
        if isinstance(error, RouteError):
            raise
        raise RouteError(f"KMZ cannot be unpacked ({error})") from error
    if len(text) > MAX_KML_BYTES:
        raise RouteError(f"KML in the KMZ is larger than {MAX_KML_BYTES // 10**6} MB")
    return read_wpml(text) if chosen[0].lower().endswith(".wpml") else read_kml(text)


def _chosen_members(members: list[str]) -> list[str]:
    """The members with the route: waylines of DJI (beside a template in KML), else `doc.kml`."""
    waylines = [name for name in members if name.lower().endswith(".wpml")]
    names = [name for name in members if name.lower().endswith(".kml")]
    return waylines or [name for name in names if name.lower() == "doc.kml"] or names


def read_kml(data: bytes) -> list[Route]:
    """Lines and tracks of all placemarks, those of one placemark joined. Raises `RouteError`."""
    root = read_markup(data, "KML")
    if root.tag != "kml":
        raise RouteError(f"KML must begin with <kml>, got <{root.tag:.40}>")
    marks = list(root.iter("Placemark"))
    found = [route for mark in marks for route in _routes(mark)]
    if found:
        points = [_named(mark, point) for mark in marks for point in mark.iter("Point")]
        return [route.leaving_out(points) for route in found]
    if any(element.tag == "missionConfig" for element in root.iter()):
        raise RouteError(
            "KML is the template of a DJI mission; give its waylines.wpml, or the whole KMZ"
        )
    kinds = sorted({each.tag for mark in marks for each in mark.iter()})
    held = [kind for kind in kinds if kind in _POINTLESS] or ["no placemark with a geometry"]
    raise RouteError(f"KML holds no LineString and no gx:Track; it holds {', '.join(held)}")


def _named(mark: Element, point: Element) -> tuple[str, list[float]]:
    name = f"point {text_of(mark, 'name') or '(no name)':.40}"
    return name, numbers_in(text_of(point, "coordinates") or "")


def _routes(mark: Element) -> list[Route]:
    places = [
        place
        for element in mark.iter()
        if element.tag in ("LineString", "Track")
        for place in (_line(element) if element.tag == "LineString" else _track(element))
    ]
    if not places:
        return []
    heights = tuple(height for _, _, height in places)
    waypoints = tuple((lat, lon) for lat, lon, _ in places)
    return [Route(waypoints, heights if any(heights) else (), name=text_of(mark, "name"))]


def _line(element: Element) -> Iterator[_Place]:
    """Positions of `lon,lat[,alt]` tuples separated by spaces; spaces at commas are accepted."""
    frame = _HEIGHT_FRAMES.get(text_of(element, "altitudeMode") or "")
    text = re.sub(r"\s+", " ", text_of(element, "coordinates") or "")  # linear, unlike \s*,\s*
    text = text.replace(" ,", ",").replace(", ", ",")
    for number, found in enumerate(re.finditer(r"\S+", text), 1):
        require_few_waypoints(number)
        yield _place(found.group().split(","), frame, found.group())


def _track(element: Element) -> Iterator[_Place]:
    frame = _HEIGHT_FRAMES.get(text_of(element, "altitudeMode") or "")
    for coordinates in element.iter("coord"):
        text = (coordinates.text or "").strip()
        if text:  # the schema allows gaps
            yield _place(text.split(), frame, text)


def _place(values: list[str], frame: HeightFrame | None, text: str) -> _Place:
    if not 2 <= len(values) <= 3:
        raise RouteError(f"KML position must be longitude,latitude[,altitude], got {text!r:.60}")
    lon, lat, *rest = (parsed(value, "KML position") for value in values)
    height = Height(rest[0], frame) if rest and frame is not None else None
    return lat, lon, height


def _check_archive(data: bytes) -> None:
    """Refuse archives with so many members that their list alone would exhaust memory."""
    at = data.rfind(b"PK\x05\x06")
    if at < 0 or len(data) - at < _END.size:
        raise RouteError("KMZ is not a complete zip archive (its end is missing)")
    members = _END.unpack_from(data, at)[4]
    if members > MAX_MEMBERS or data[max(0, at - 20) : at].startswith(b"PK\x06\x07"):
        raise RouteError(f"KMZ has more than {MAX_MEMBERS:,} members")
