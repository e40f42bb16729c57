"""Routes as KML, KMZ and GPX, and what such files can do to a reader."""

import struct
import zipfile
from io import BytesIO

import pytest

from orthonav.core.errors import RouteError
from orthonav.ground.planning import markup
from orthonav.ground.planning.route import Height

BAD_LATITUDE = "a latitude within 90"
PLACES = ((46.5, 2.5), (46.51, 2.53), (46.49, 2.55))
LINE = "<coordinates>\n 2.5,46.5,120 2.53,46.51,130\n\t2.55,46.49,140 </coordinates>"
TRACK = (
    "<gx:Track><when>2024-01-01T00:00:00Z</when><gx:coord>2.5 46.5 120</gx:coord>"
    "<gx:coord/><gx:coord>2.53 46.51 130</gx:coord><gx:coord>2.55 46.49 140</gx:coord></gx:Track>"
)


def kml_of(*marks, namespaces=True):
    spaces = 'xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"'
    named = (f"<Placemark><name>{name}</name>{shape}</Placemark>" for name, shape in marks)
    inner = f"<Document><Folder>{''.join(named)}</Folder></Document>"
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    return f"{head}<kml {spaces if namespaces else ''}>{inner}</kml>"


def line(mode=None, coordinates=LINE):
    altitude = f"<altitudeMode>{mode}</altitudeMode>" if mode else ""
    return f"<LineString><tessellate>1</tessellate>{altitude}{coordinates}</LineString>"


def archive(*members):
    out = BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as zipped:
        for name, text in members:
            entry = zipfile.ZipInfo(name)  # of 1980: cases of pytest are named by these bytes
            zipped.writestr(entry, text, zipfile.ZIP_DEFLATED)
    return out.getvalue()


@pytest.mark.parametrize(
    "geometry, frame",
    [
        (line(), None),
        (line("clampToGround"), None),
        (line("relativeToGround"), "agl"),
        (line("absolute"), "amsl"),
        (TRACK, None),
        (TRACK.replace("<when>", "<altitudeMode>absolute</altitudeMode><when>"), "amsl"),
        (f"<gx:MultiTrack>{TRACK}</gx:MultiTrack>", None),
    ],
)
@pytest.mark.parametrize("namespaces", [True, False])
def test_lines_and_tracks_of_kml(read, geometry, frame, namespaces):
    point = ("start", "<Point><coordinates>1,2,0</coordinates></Point>")
    route = read(kml_of(point, ("way", geometry), namespaces=namespaces), "a.kml")
    assert route.waypoints == PLACES and route.name == "way"
    expected = tuple(Height(metres, frame) for metres in (120, 130, 140))
    assert route.heights == (expected if frame else ())


def test_lines_of_one_placemark_are_joined_and_placemarks_picked_by_name(read):
    halves = ("2.5, 46.5 2.53, 46.51", "2.55,46.49")
    both = "".join(line(coordinates=f"<coordinates>{half}</coordinates>") for half in halves)
    text = kml_of(("way", f"<MultiGeometry>{both}</MultiGeometry>"), ("é &amp; b", TRACK))
    assert read(text, "a.kml#way").waypoints == PLACES
    assert read(text, "a.kml#é & b").waypoints == PLACES
    with pytest.raises(RouteError, match=r"2 lines; give .*: 1 'way', 2 'é & b'"):
        read(text, "a.kml")


def test_files_that_a_kml_links_to_are_named(read, caplog):
    link = "</Folder><NetworkLink><Link><href>files/way.kml</href></Link></NetworkLink></Document>"
    text = kml_of().replace("</Folder></Document>", link)
    with pytest.raises(RouteError, match=r"no LineString .* not read: files/way\.kml"):
        read(archive(("doc.kml", text)), "a.kmz")
    text = kml_of(("way", line())).replace("</Folder></Document>", link)
    assert read(text, "a.kml").waypoints == PLACES
    assert "files that it links to are not read: files/way.kml" in caplog.text


def test_kmz_is_kml_in_an_archive(read):
    text = kml_of(("way", line()))
    assert read(archive(("doc.kml", text), ("files/b.kml", "<x/>")), "a.kmz").waypoints == PLACES
    assert read(archive(("way.KML", text), ("a.png", "x")), "a.kmz").waypoints == PLACES


WAYPOINT = """<Placemark><Point><coordinates>{lon},{lat},0</coordinates></Point>
<wpml:index>{index}</wpml:index><wpml:executeHeight>{height}</wpml:executeHeight></Placemark>"""


def wayline(mode="relativeToStartPoint", ident=0, order=(0, 1, 2)):
    places = ((i, *PLACES[i]) for i in order)
    marks = [WAYPOINT.format(lat=lat, lon=lon, index=i, height=50 + i) for i, lat, lon in places]
    head = f"<wpml:executeHeightMode>{mode}</wpml:executeHeightMode>"
    return f"<Folder>{head}<wpml:waylineId>{ident}</wpml:waylineId>{''.join(marks)}</Folder>"


def wpml_of(*folders):
    spaces = 'xmlns="http://www.opengis.net/kml/2.2" xmlns:wpml="http://www.dji.com/wpmz/1.0.2"'
    config = "<wpml:missionConfig/>"
    return f"<kml {spaces}><Document>{config}{''.join(folders)}</Document></kml>"


@pytest.mark.parametrize(
    "mode, frame",
    [("relativeToStartPoint", "home"), ("WGS84", "hae"), ("realTimeFollowSurface", "agl")],
)
@pytest.mark.parametrize("packed", [False, True])
def test_waylines_of_dji(read, mode, frame, packed):
    content, name = wpml_of(wayline(mode, order=(2, 0, 1))), "a.wpml"
    if packed:
        template = wpml_of(wayline())
        members = ("wpmz/template.kml", template), ("wpmz/waylines.wpml", content)
        content, name = archive(*members), "a.kmz"
    route = read(content, name)
    assert route.waypoints == PLACES
    assert route.heights == tuple(Height(50.0 + i, frame) for i in range(3))


def test_several_waylines_are_picked_by_identifier_or_number(read):
    both = wpml_of(wayline(ident=7), wayline(ident=8, order=(0, 1)))
    with pytest.raises(RouteError, match=r"2 lines; .*: 1 '7', 2 '8'"):
        read(both, "a.wpml")
    assert len(read(both, "a.wpml#8").waypoints) == len(read(both, "a.wpml#2").waypoints) == 2


@pytest.mark.parametrize(
    "content, name, message",
    [
        (wpml_of(), "a.wpml", "no wayline with waypoints"),
        (wpml_of(wayline("aboveTheMoon")), "a.wpml", "executeHeightMode must be relative"),
        (wpml_of(wayline()).replace("<wpml:index>1", "<wpml:index>x"), "a.wpml", "WPML index"),
        (wpml_of(wayline()).replace("2.5,46.5,0", "2.5"), "a.wpml", "must be longitude,lat"),
        (wpml_of(), "a.kml", "template of a DJI mission: give its waylines.wpml"),
        ("<gpx/>", "a.wpml", "must begin with <kml>"),
    ],
)
def test_waylines_that_are_none(read, content, name, message):
    with pytest.raises(RouteError, match=message):
        read(content, name)


GPX = """<?xml version="1.0"?>
<gpx version="1.1" creator="test" xmlns="http://www.topografix.com/GPX/1/1">
<wpt lat="1" lon="1"/>{}</gpx>"""
POINTS = '<{0} lat="46.5" lon="2.5"><ele>120</ele></{0}><{0} lat="46.51" lon="2.53"/>'
LAST = '<{0} lat="46.49" lon="2.55"><time>2024-01-01T00:00:00Z</time></{0}>'
ROUTE = "<rte><name>planned</name>" + (POINTS + LAST).format("rtept") + "</rte>"
SEGMENTS = (
    f"<trk><name>flown</name><trkseg>{POINTS}</trkseg><trkseg/><trkseg>{LAST}</trkseg></trk>"
).format("trkpt")


@pytest.mark.parametrize("inner, name", [(ROUTE, "planned"), (SEGMENTS, "flown")])
@pytest.mark.parametrize("version", ["1/0", "1/1"])
def test_routes_and_tracks_of_gpx(read, inner, name, version):
    route = read(GPX.format(inner).replace("1/1", version), "a.gpx")
    assert route.waypoints == PLACES and route.name == name
    assert route.heights == (Height(120, "amsl"), None, None)


def test_a_route_comes_before_a_track_and_names_choose(read, caplog):
    assert read(GPX.format(SEGMENTS + ROUTE), "a.gpx").name == "planned"
    assert "route: using rte, not flown: routes come before tracks" in caplog.text
    two = GPX.format(ROUTE + ROUTE.replace("planned", "other"))
    assert read(two, "a.gpx#other").name == "other"
    with pytest.raises(RouteError, match="1 'planned', 2 'other'"):
        read(two, "a.gpx")


BOMB = '<!DOCTYPE lolz [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]><kml>&b;</kml>'
OUTSIDE = '<!DOCTYPE kml SYSTEM "file:///etc/passwd"><kml/>'


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("a.kml", "", "KML file is empty"),
        ("a.kml", "<kml>", "not well-formed XML"),
        ("a.kml", '<?xml version="1.0" encoding="klingon"?><kml/>', "KML file"),
        ("a.kml", BOMB, "has a DOCTYPE"),
        ("a.kml", OUTSIDE, "has a DOCTYPE"),
        ("a.gpx", OUTSIDE.replace("<kml/>", "<gpx/>"), "has a DOCTYPE"),
        ("a.kml", "<kml>" + "<a>" * 100, "more than .* 100 levels"),
        ("a.kml", "<gpx/>", "must begin with <kml>, got <gpx>"),
        ("a.kml", kml_of(("a", line(coordinates=""))), "no LineString"),
        ("a.kml", kml_of(("a", line(coordinates=LINE.replace("46.51", "x")))), "must be a number"),
        ("a.kml", kml_of(("a", line(coordinates=LINE.replace("46.51", "96")))), BAD_LATITUDE),
        ("a.kml", kml_of(("a", line(coordinates=LINE.replace(",130", ",1,1")))), "longitude,lat"),
        ("a.kmz", b"PK\x03\x04 cut off", "not a complete zip archive"),
        ("a.kmz", archive(("a.txt", "x")), "one KML file, got 0"),
        ("a.kmz", archive(("a.kml", "<kml/>"), ("b.kml", "<kml/>")), "one KML file, got 2"),
        ("a.kmz", archive(("a.kml", "<kml/>" * 50))[:-60], "zip archive"),
        ("a.gpx", "<gpx/>", "no route"),
        ("a.gpx", GPX.format("<rte/><trk><trkseg/></trk>"), "no route"),
        ("a.gpx", GPX.format(ROUTE.replace('lat="46.51"', "")), "GPX lat must be a number"),
        ("a.gpx", GPX.format(ROUTE.replace("46.51", "nan")), "GPX lat must be a number"),
        ("a.gpx", GPX.format(ROUTE.replace(">120<", ">high<")), "ele must be a number"),
    ],
)
def test_broken_and_harmful_files_are_refused(read, name, content, message):
    with pytest.raises(RouteError, match=message):
        read(content, name)


def test_what_unpacks_to_too_much_is_refused(read, monkeypatch):
    monkeypatch.setattr(markup, "MAX_KML_BYTES", 1000)
    with pytest.raises(RouteError, match="KML in the KMZ is larger than"):
        read(archive(("doc.kml", "<kml>" + " " * 100_000 + "</kml>")), "a.kmz")
    monkeypatch.setattr(markup, "MAX_ELEMENTS", 10)
    with pytest.raises(RouteError, match="more than 10 elements"):
        read("<gpx>" + "<a/>" * 10 + "</gpx>", "a.gpx")


def test_archives_of_many_members_or_with_a_password_are_refused(read):
    whole = archive(("doc.kml", kml_of(("way", line()))))
    at = whole.rindex(b"PK\x05\x06")
    many = whole[: at + 8] + struct.pack("<2H", 20_000, 20_000) + whole[at + 12 :]
    with pytest.raises(RouteError, match="more than 10,000 members"):
        read(many, "a.kmz")
    flag = whole.rindex(b"PK\x01\x02") + 8
    locked = bytearray(whole)
    locked[flag] |= 1
    with pytest.raises(RouteError, match="cannot be unpacked"):
        read(bytes(locked), "a.kmz")


def test_spaces_in_coordinates_take_linear_time(read):
    """The time of a search for spaces around commas would grow with the square of their number."""
    text = f"<coordinates>1 ,\n2{' ' * 3_000_000}3 , 4, 5</coordinates>"
    assert read(kml_of(("way", line(coordinates=text))), "a.kml").waypoints == ((2, 1), (4, 3))
