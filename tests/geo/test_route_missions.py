"""Missions as ground stations write them: plans of QGroundControl, waypoint files."""

import pytest

from orthonav.core.errors import RouteError
from orthonav.ground.planning.route import Height, Route

HOME = [47.3977419, 8.545594, 487.989]
A, B, C = (47.40, 8.55), (47.41, 8.56), (47.42, 8.57)


def simple(command, place=(None, None), height=None, frame=3, **more):
    params = [0, 0, 0, None, *place, height]
    item = {"type": "SimpleItem", "command": command, "frame": frame, "params": params}
    return item | {"autoContinue": True, "doJumpId": 1} | more


def transects(kind, points, camera=None, **more):
    inner = {
        "CameraCalc": camera or {"DistanceToSurface": 60, "DistanceToSurfaceRelative": True},
        "VisualTransectPoints": [list(point) for point in points],
        "Items": [],
        "version": 1,
    }
    item = {"type": "ComplexItem", "complexItemType": kind, "version": 2, **more}
    return item | {"TransectStyleComplexItem": inner}


def plan(*items, home=HOME):
    mission = {"items": list(items), "plannedHomePosition": home, "version": 2}
    return {"fileType": "Plan", "groundStation": "QGroundControl", "mission": mission, "version": 1}


@pytest.fixture
def read(read):
    return lambda document, name="a.plan": read(document, name)


@pytest.mark.parametrize("name", ["a.plan", "a.json"])
def test_waypoints_of_a_plan(read, name):
    route = read(
        plan(
            simple(22, A, 50),
            simple(178, height=5),  # speed
            simple(16, B, 60, frame=0),
            simple(206),  # camera
            simple(195, (1.0, 1.0), 3, frame=0),  # region of interest
            simple(82, C, 70, frame=10),
            simple(21, A, 0),
        ),
        name,
    )
    assert route.waypoints == (A, B, C, A)
    frames = ("home", 50), ("amsl", 60), ("agl", 70), ("home", 0)
    assert route.heights == tuple(Height(height, frame) for frame, height in frames)
    assert route.home_amsl_m == HOME[2] and route.leg_bands_m == ()


def test_a_plan_goes_home_and_takes_off_there(read):
    home = (HOME[0], HOME[1])
    route = read(plan(simple(22, height=50), simple(16, A, 50), simple(20), simple(16, B, 1)))
    assert route.waypoints == (home, A, home)
    assert route.heights == (None, Height(50, "home"), None)
    assert read(plan(simple(16, A, 5), simple(20), home=[0, 0, 0])).waypoints == (A,)
    assert read(plan(simple(16, A), simple(17, (0, 0), 5), simple(16, B))).waypoints == (A, B)


def test_heights_above_terrain_that_a_plan_summed_up_itself(read):
    route = read(plan(simple(16, A, 512.5, frame=0, AltitudeMode=3, Altitude=40)))
    assert route.heights == (Height(40, "agl"),)
    old = {"type": "SimpleItem", "command": 16, "frame": 3, "coordinate": [*A, 33], "param1": 0}
    assert read(plan(old)).heights == (Height(33, "home"),)


@pytest.mark.parametrize(
    "camera, frame",
    [
        ({"DistanceToSurface": 60, "DistanceToSurfaceRelative": True}, "home"),
        ({"DistanceToSurface": 60, "DistanceToSurfaceRelative": False}, "amsl"),
        ({"DistanceToSurface": 60, "DistanceMode": 1}, "home"),
        ({"DistanceToSurface": 60, "DistanceMode": 2}, "amsl"),
        ({"DistanceToSurface": 60, "DistanceMode": 3}, "agl"),
        ({"DistanceToSurface": 60, "DistanceMode": 4}, "agl"),
        ({"DistanceToSurface": 60}, "agl"),
    ],
)
def test_a_survey_is_flown_along_its_transects(read, camera, frame):
    survey = transects("survey", (A, C, B), camera, polygon=[list(A), list(B), list(C)])
    survey["TransectStyleComplexItem"]["FollowTerrain"] = len(camera) == 1  # an older survey
    route = read(plan(survey))
    assert route.waypoints == (A, C, B)
    assert route.heights == (Height(60, frame),) * 3 and route.leg_bands_m == ()


def test_a_corridor_has_a_band_of_its_own(read):
    corridor = transects("CorridorScan", (A, B, C), CorridorWidth=50, polyline=[list(A), list(C)])
    other = transects("CorridorScan", (C, A), CorridorWidth=70, EntryPoint=0)
    route = read(plan(simple(16, C, 9), corridor, other, simple(16, B, 9)))
    assert route.waypoints == (C, A, B, C, C, A, B)
    assert route.leg_bands_m == (None, 50, 50, None, 70, None)
    assert route.bands_m(300) == (300, 50, 50, 300, 70, 300)
    along = transects("CorridorScan", (A, B), CorridorWidth=0)  # flown over the line itself
    assert read(plan(along)).leg_bands_m == ()


@pytest.mark.parametrize("kind", ["fwLandingPattern", "vtolLandingPattern"])
@pytest.mark.parametrize("approach", ["landingApproachCoordinate", "loiterCoordinate"])
def test_a_landing_pattern_is_flown_to_its_end(read, kind, approach):
    landing = {
        "type": "ComplexItem",
        "complexItemType": kind,
        approach: [*B, 40],
        "landCoordinate": [*C, 0],
        "altitudesAreRelative": False,
    }
    route = read(plan(simple(16, A, 50), landing))
    assert route.waypoints == (A, B, C)
    assert route.heights[1:] == (Height(40, "amsl"), Height(0, "amsl"))


SCAN = {"type": "ComplexItem", "complexItemType": "StructureScan"}


@pytest.mark.parametrize(
    "document, message",
    [
        ("", "is empty"),
        ("[]", "must be a JSON object"),
        ({"fileType": "Parameters"}, "fileType 'Plan', got 'Parameters'"),
        ({"fileType": "Plan"}, "cannot be read .mission is missing"),
        (plan(), "no waypoint with a position"),
        (plan(3), "cannot be read"),
        (plan({"type": "Other"}), "item 1 of the plan is a 'Other'"),
        (plan(simple(16, A) | {"params": [1, 2]}), "cannot be read .coordinate is missing"),
        (plan(simple(16, ("47", 8))), "params must be a number, got '47'"),
        (plan(simple(16, A, frame=1)), "MAV_FRAME 1; expected a global one"),
        (plan(simple("16", A)), "command must be a number"),
        (plan(simple(16, (91, 8), 5)), "a latitude within 90"),
        (plan(simple(16, A, 1e9)), "height of a waypoint"),
        (plan(home=["x", 8, 0]), "plannedHomePosition must be a number"),
        (plan(simple(16, A), SCAN), "item 2 .* a 'StructureScan': only surveys, .*remove it from"),
        (plan(transects("survey", ())), "item 1 of the plan .survey. has no Visual"),
        (plan(transects("CorridorScan", (A, B), CorridorWidth=-5)), "band of a leg must be wider"),
    ],
)
def test_invalid_plans_are_refused(read, document, message):
    with pytest.raises(RouteError, match=message):
        read(document)


WPL = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t47.39\t8.54\t488\t1
# a comment
1\t0\t3\t22\t15\t0\t0\t0\t0\t0\t50\t1
2\t0\t3\t16\t0\t0\t0\t0\t47.40\t8.55\t60\t1
3\t0\t3\t178\t0\t12\t0\t0\t0\t0\t0\t1
4\t0\t10\t82\t0\t0\t0\t0\t47.41\t8.56\t70\t1
5\t0\t0\t18\t3\t0\t0\t0\t47.42\t8.57\t600\t1
6\t0\t3\t17\t0\t0\t0\t0\t0\t0\t70\t1
7\t0\t3\t177\t2\t3\t0\t0\t0\t0\t0\t1
8\t0\t0\t20\t0\t0\t0\t0\t0\t0\t0\t1
"""


@pytest.mark.parametrize("name", ["a.waypoints", "a.txt", "a.TXT", "a.csv"])
def test_a_waypoint_file(read, name):
    home = (47.39, 8.54)
    route = read(WPL, name)
    assert route.waypoints == (home, A, B, C, home)
    heights = Height(60, "home"), Height(70, "agl"), Height(600, "amsl")
    assert route == Route(route.waypoints, (None, *heights, None), home_amsl_m=488)
    assert read(WPL.replace("\t", " ").replace("\n", "\r\n"), name) == route


def test_older_waypoint_files_have_no_home(read):
    text = WPL.replace("110", "120").split("\n6\t")[0]
    assert read(text, "a.txt").waypoints == ((47.39, 8.54), A, B, C)
    nowhere = WPL.replace("47.39\t8.54\t488", "0\t0\t0")
    assert read(nowhere, "a.txt").waypoints == (A, B, C)
    assert read(nowhere, "a.txt").home_amsl_m is None


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "is empty"),
        ("QGC WPL 110\n", "no waypoint with a position"),
        ("QGC WPL 100\n1", "must begin with 'QGC WPL 110', got 'QGC WPL 100'"),
        ("QGC WPL 110\n1\t2\n", "line 2 of the waypoint file has 2 values, expected 12"),
        (WPL.replace("47.40", "north"), "line 5, column 9 must be a number"),
        (WPL.replace("\t82\t", "\t82.5\t"), "line 7: number, frame and command must be whole"),
    ],
)
def test_invalid_waypoint_files_are_refused(read, text, message):
    with pytest.raises(RouteError, match=message):
        read(text, "a.waypoints")


LOST = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t47.39\t8.54\t488\t1
1\t0\t3\t0\t0\t0\t0\t0\t47.40\t8.55\t60\t1
2\t0\t3\t16\t0\t0\t0\t0\t47.40\t8.55\t60\t1
3\t0\t3\t34\t30\t0\t0\t0\t47.41\t8.56\t60\t1
4\t0\t3\t201\t0\t0\t0\t0\t47.6\t8.6\t0\t1
5\t0\t3\t203\t0\t0\t0\t0\t1\t0\t0\t1
6\t0\t3\t30001\t0\t0\t0\t0\t47.42\t8.57\t60\t1
7\t0\t0\t20\t0\t0\t0\t0\t0\t0\t0\t1
8\t0\t3\t16\t0\t0\t0\t0\t47.5\t8.5\t60\t1
"""


def test_positions_that_are_left_out_of_a_mission_are_named(read, caplog):
    route = read(LOST, "a.waypoints")
    assert route.waypoints == (A, B, (47.39, 8.54)), "an orbit is flown, a camera's target is not"
    assert "positions that are not part of the route" in caplog.text
    named = "item 1 (command 0), item 6 (command 30001), item 8 (command 16) after the return"
    assert named in caplog.text
    with pytest.raises(RouteError, match=r"left out are item 1 \(command 0\)"):
        read(plan(simple(0, B, 50)))


@pytest.mark.parametrize("frame, height, said", [
    (3, 60, "item 0 is flown to, as it is in frame 3: a home position is in 0"),
    (0, 600, "item 0 is taken as the home position, which is not flown to"),
    (0, 488, None),
])  # fmt: skip
def test_item_0_is_a_waypoint_in_the_frame_of_waypoints(read, caplog, frame, height, said):
    """As MAVROS and converters from tables write it; a home position has frame 0."""
    text = WPL.replace("1\t0\t16\t0\t0\t0\t0\t47.39\t8.54\t488",
                       f"1\t{frame}\t16\t0\t0\t0\t0\t47.39\t8.54\t{height}")  # fmt: skip
    route = read(text, "a.waypoints")
    home = (47.39, 8.54)
    # The return ends at item 0 in any frame.
    assert route.waypoints == ((home, home, A, B, C, home) if frame else (home, A, B, C, home))
    assert route.heights[0] == (Height(60, "home") if frame else None)
    assert (said in caplog.text) if said else not caplog.text


def test_the_first_item_of_a_waypoint_file_is_home_only_where_it_is_number_0(read):
    assert read(LOST.replace("\n0\t1", "\n1\t1"), "a.txt").waypoints == ((47.39, 8.54), A, B)
