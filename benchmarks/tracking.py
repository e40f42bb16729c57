"""Following a flight against placing its views one by one: time, accuracy, growth with the map."""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.inputs import FLIGHT_SEED, PAST, PRESENT, Workplace
from benchmarks.record import Section, Table, number
from benchmarks.verdicts import percent
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import CONFIDENT, Fix, ViewResult
from orthonav.core.track.tracker import Tracker
from orthonav.ground.planning.route import Route
from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight
from orthonav.onboard.run import Locator, SingleViews, localize_flight

SIDES_M = (1000, 4000, 10000)
TURNS_EN_M = ((-330, -330), (-330, 300), (-60, 330), (60, -330), (330, -300), (330, 330))
"""A route over the inner kilometre, metres east and north of its centre."""
SPACING_M, AGL_M = 40.0, 150.0
ERRORS = Errors(yaw_std_deg=5.0, agl_std=0.05)
HEADER = (
    *("area km2", "views", "method", "ms", "p99 ms", "first view ms", "found at view"),
    *("15 m", "median m", "confident and wrong"),
)
RIGHT_M = 15.0


def measure(place: Workplace) -> Section:
    """The same views over maps of growing size, followed and one by one."""
    section = Section("Following a flight")
    present = place.area(SIDES_M[0], 1.0, [PRESENT])[0]
    rows = []
    for side_m in SIDES_M[:1] if place.quick else SIDES_M:
        localizer = Localizer(open_map(place.map(place.area(side_m, 1.0, [PAST])[0])))
        folder = _flown(place, localizer, present)
        for method in ("tracked", "one by one"):
            locator: Locator = SingleViews(localizer, use_prior=False)
            if method == "tracked":
                locator = Tracker(localizer, use_prior=False)
            rows.append(_row(section, side_m, method, localizer, folder, locator))
            print(f"        {side_m} m, {method} done", file=sys.stderr, flush=True)
    notes = (
        f"a flight of {AGL_M:g} m height, a view every {SPACING_M:g} m, 1 s apart, of another date "
        "than the map's, heading off by 5 deg and height by 5 % (standard deviations, drawn for "
        "each view), no prior, whole map; one core",
        "found at view: the first that is tracking; 15 m, median, ms and p99 from there on (one by "
        "one: of all); confident and wrong: views more than 35 m off with a confidence of at "
        "least 0.9",
    )
    section.tables = [Table("Following a flight", HEADER, rows, notes)]
    return section


def _flown(place: Workplace, localizer: Localizer, present: Path) -> Path:
    folder = place.scratch / f"followed-{present.parent.name}"
    if not folder.is_dir():
        turns = TURNS_EN_M[:2] if place.quick else TURNS_EN_M
        lat, lon = localizer.sheet.frame.latlon_from_en(np.array(turns, np.float64))
        request = SimulateRequest(
            [present],
            folder,
            route=Route(tuple(zip(lat.tolist(), lon.tolist(), strict=True))),
            agl_m=AGL_M,
            spacing_m=SPACING_M,
            errors=ERRORS,
            seed=FLIGHT_SEED,
        )
        simulate_flight(request)
    return folder


def _row(
    section: Section,
    side_m: int,
    method: str,
    localizer: Localizer,
    folder: Path,
    locator: Locator,
) -> list[str]:
    results = list(localize_flight(locator, open_flight(folder)))
    truth = read_truth(folder / "truth.csv")
    errors = np.array([_error_m(each, localizer, truth[each.frame]) for each in results])
    confident = np.array(
        [isinstance(r.outcome, Fix) and r.outcome.confidence >= CONFIDENT for r in results]
    )
    times = np.array([each.latency_ms for each in results])
    tracking = [number for number, r in enumerate(results) if r.state in (None, "tracking")]
    first = tracking[0] if tracking else len(results)
    # The first view of all prepares the map.
    warm = times[max(first, 1) :]
    name, data = f"{side_m} m, {method}", f"generated {side_m} m square, 1 m"
    time = section.add(f"{name}: time", "ms", warm, data=data, seed=FLIGHT_SEED)
    hits = errors[first:] <= RIGHT_M
    section.add_share(f"{name}: within 15 m", hits, data=data, seed=FLIGHT_SEED)
    wrong = int((confident & (errors > 35.0)).sum())
    return [
        number((side_m / 1000) ** 2),
        str(len(results)),
        method,
        number(time.median),
        number(float(np.percentile(warm, 99))),
        number(float(times[0])),
        str(first + 1) if method == "tracked" else "-",
        percent(float(hits.mean())),
        number(float(np.median(errors[first:]))),
        str(wrong),
    ]


def _error_m(result: ViewResult, localizer: Localizer, truth: tuple[float, float]) -> float:
    if not isinstance(result.outcome, Fix):
        return float("inf")
    frame = localizer.sheet.frame
    place: NDArray[np.float64] = frame.en_from_latlon(
        result.outcome.lat_deg, result.outcome.lon_deg
    )
    return float(np.hypot(*(place - frame.en_from_latlon(*truth))))
