"""Routes in XML: GPX 1.0 and 1.1 (topografix.com/GPX/1/1), KML (OGC 07-147r2, and Google's
gx:Track), KMZ, which is KML in a zip archive, and waylines of DJI's waypoint missions (WPML:
https://developer.dji.com/doc/cloud-api-tutorial/en/api-reference/dji-wpml/waylines-wpml.html).

Files are of unknown origin: no DTD is read, hence no entities and no external files. defusedxml and
gpxpy are not used: neither limits the number and depth of elements, and 20 MB of empty elements
would take gigabytes."""

import logging
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from io import BytesIO
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from orthonav.core.errors import RouteError
from orthonav.core.flight.recording import chosen
from orthonav.ground.planning.record import (
    Height,
    HeightFrame,
    Route,
    parsed,
    require_few_waypoints,
)

MAX_ELEMENTS = 1_000_000
MAX_KML_BYTES = 20_000_000
_Place = tuple[float, float, Height | None]
log = logging.getLogger(__name__)


def read_markup(data: bytes, kind: str, root: str) -> Element:
    """The root of a document, with namespaces removed from its tags: `gx:Track` is Track. `kind`:
    of the document, for messages."""
    if not data.strip():
        raise RouteError(f"{kind} file is empty")
    builder = _Builder(kind)
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartDoctypeDeclHandler = builder.doctype
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise RouteError(f"{kind} file is not well-formed XML ({error})") from error
    except (ValueError, LookupError) as error:  # unknown encoding
        raise RouteError(f"{kind} file cannot be read ({error})") from error
    found = builder.close()
    if found.tag != root:
        raise RouteError(f"{kind} must begin with <{root}>, got <{found.tag:.40}>")
    return found


def text_of(element: Element, tag: str) -> str | None:
    return (element.findtext(tag) or "").strip() or None


class _Builder(TreeBuilder):
    def __init__(self, kind: str) -> None:
        super().__init__()
        self._kind = kind
        self._count = self._depth = 0

    def doctype(self, *_: object) -> None:
        raise RouteError(f"{self._kind} file has a DOCTYPE, which is not read; remove it")

    def start(self, tag: str, attributes: dict[str, str]) -> Element:
        self._count += 1
        self._depth += 1
        if self._count > MAX_ELEMENTS or self._depth > 100:
            raise RouteError(
                f"{self._kind} file has more than {MAX_ELEMENTS:,} elements or 100 levels"
            )
        return super().start(tag.rpartition(":")[2], attributes)

    def end(self, tag: str) -> Element:
        self._depth -= 1
        return super().end(tag.rpartition(":")[2])


def read_gpx(data: bytes) -> list[Route]:
    """All routes (`rte`), else all tracks (`trk`), the segments of each joined. Heights are above
    mean sea level."""
    root = read_markup(data, "GPX", "gpx")
    planned = [_gpx_route(each, "rtept") for each in root.iterfind("rte[rtept]")]
    flown = [each for each in root.iterfind("trk") if each.find("trkseg/trkpt") is not None]
    if planned and flown:
        tracks = [text_of(each, "name") or "(no name)" for each in flown]
        log.warning("%s", chosen("route", "rte", tracks, "routes come before tracks (trk)"))
    found = planned or [_gpx_route(each, "trkseg/trkpt") for each in flown]
    if not found:
        raise RouteError("GPX holds no route (rte) and no track (trk) with positions")
    return found


def _gpx_route(element: Element, points: str) -> Route:
    places = []
    for point in element.iterfind(points):
        lat, lon = (parsed(point.get(name) or "", f"GPX {name}") for name in ("lat", "lon"))
        places.append((lat, lon, _height(point, "ele", "amsl")))
    return _route(places, text_of(element, "name"))


def _route(places: list[_Place], name: str | None) -> Route:
    heights = tuple(height for _, _, height in places)
    return Route(tuple((lat, lon) for lat, lon, _ in places), heights, name=name)


def _height(element: Element, tag: str, frame: HeightFrame | None) -> Height | None:
    text = text_of(element, tag)
    return None if text is None else Height(parsed(text, tag), frame)


def read_kmz(data: bytes) -> list[Route]:
    """Lines and tracks of the archive's `doc.kml`, else of its only KML file; of a mission of DJI
    its waylines."""
    _check_archive(data)
    try:
        with zipfile.ZipFile(BytesIO(data)) as archive:
            members = archive.namelist()
            waylines = [name for name in members if name.lower().endswith(".wpml")]
            names = [name for name in members if name.lower().endswith(".kml")]
            documents = [name for name in names if name.lower() == "doc.kml"]
            chosen = waylines or documents or names  # waylines of DJI lie beside their template
            if len(chosen) != 1:
                raise RouteError(f"KMZ must hold one KML file, got {len(chosen)}")
            with archive.open(chosen[0]) as member:
                text = member.read(MAX_KML_BYTES + 1)
    except (
        *(zipfile.BadZipFile, zlib.error, EOFError, OSError),
        *(NotImplementedError, RuntimeError),  # encrypted, odd compression
    ) as error:
        raise RouteError(f"KMZ cannot be unpacked ({error})") from error
    if len(text) > MAX_KML_BYTES:
        raise RouteError(f"KML in the KMZ is larger than {MAX_KML_BYTES // 10**6} MB")
    return read_wpml(text) if chosen[0].lower().endswith(".wpml") else read_kml(text)


def read_kml(data: bytes) -> list[Route]:
    root = read_markup(data, "KML", "kml")
    found = []
    for mark in root.iter("Placemark"):
        lines = (each for each in mark.iter() if each.tag in _KML_PLACES)
        if places := [place for each in lines for place in _KML_PLACES[each.tag](each)]:
            found.append(_route(places, text_of(mark, "name")))
    links = [each.findtext(".//href") or "?" for each in root.iter("NetworkLink")]
    linked = f"; files that it links to are not read: {', '.join(links)}" if links else ""
    if found and linked:
        log.warning("lines of the KML are its own%s", linked)
    if not found:
        dji = "; it is the template of a DJI mission: give its waylines.wpml, or the whole KMZ"
        hint = dji if root.find(".//missionConfig") is not None else ""
        raise RouteError(f"KML holds no LineString and no gx:Track{hint}{linked}")
    return found


def _kml_frame(element: Element) -> HeightFrame | None:
    """With other altitude modes, or none, the altitude is ignored, as KML specifies."""
    frames: dict[str | None, HeightFrame] = {"absolute": "amsl", "relativeToGround": "agl"}
    return frames.get(text_of(element, "altitudeMode"))


def _line(element: Element) -> Iterator[_Place]:
    frame = _kml_frame(element)
    text = re.sub(r"\s+", " ", text_of(element, "coordinates") or "")  # linear, unlike \s*,\s*
    text = text.replace(" ,", ",").replace(", ", ",")
    for number, found in enumerate(re.finditer(r"\S+", text), 1):
        require_few_waypoints(number)
        yield _kml_place(found.group().split(","), frame, found.group())


def _track(element: Element) -> Iterator[_Place]:
    frame = _kml_frame(element)
    for coordinates in element.iter("coord"):
        text = (coordinates.text or "").strip()
        if text:  # the schema allows gaps
            yield _kml_place(text.split(), frame, text)


_KML_PLACES = {"LineString": _line, "Track": _track}


def _kml_place(values: list[str], frame: HeightFrame | None, text: str) -> _Place:
    if not 2 <= len(values) <= 3:
        raise RouteError(f"KML position must be longitude,latitude[,altitude], got {text!r:.60}")
    lon, lat, *rest = (parsed(value, "KML position") for value in values)
    height = Height(rest[0], frame) if rest and frame is not None else None
    return lat, lon, height


def _check_archive(data: bytes) -> None:
    end, at = struct.Struct("<4s4H2LH"), data.rfind(b"PK\x05\x06")
    if at < 0 or len(data) - at < end.size:
        raise RouteError("KMZ is not a complete zip archive (its end is missing)")
    members = end.unpack_from(data, at)[4]
    if members > 10_000 or data[max(0, at - 20) : at].startswith(b"PK\x06\x07"):
        raise RouteError("KMZ has more than 10,000 members")


def read_wpml(data: bytes) -> list[Route]:
    """The waylines of a mission, one route per folder, their waypoints by index."""
    root = read_markup(data, "WPML", "kml")
    found = [route for folder in root.iter("Folder") for route in _waylines(folder)]
    if not found:
        raise RouteError("WPML holds no wayline with waypoints")
    return found


def _waylines(folder: Element) -> Iterator[Route]:
    mode = text_of(folder, "executeHeightMode")
    frames: dict[str, HeightFrame] = {
        "relativeToStartPoint": "home",
        "WGS84": "hae",
        "realTimeFollowSurface": "agl",
    }
    if mode is not None and mode not in frames:
        raise RouteError(f"WPML executeHeightMode must be {', '.join(frames)}, got {mode!r:.60}")
    frame = None if mode is None else frames[mode]
    marks = folder.findall("Placemark[Point]")
    require_few_waypoints(len(marks))
    marks.sort(key=lambda mark: parsed(text_of(mark, "index") or "", "WPML index"))
    if marks:
        texts = [text_of(mark, "Point/coordinates") or "" for mark in marks]
        points = [_kml_place(text.split(","), None, text) for text in texts]
        heights = [_height(mark, "executeHeight", frame) for mark in marks]  # that are flown
        places = [(*point[:2], height) for point, height in zip(points, heights, strict=True)]
        yield _route(places, text_of(folder, "waylineId"))
