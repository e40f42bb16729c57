"""Following a flight against localizing its views one by one: time and accuracy by map size."""

import argparse
import sys
from pathlib import Path

import numpy as np

from benchmarks.looped_flight import route_of
from benchmarks.record import Section, Table, number, percent, quantiles, run, say
from benchmarks.scenes import FAR_M, PAST, PRESENT, area, map_of
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix
from orthonav.core.track.tracker import Tracker
from orthonav.ground.recordings.localize import localize_flight
from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight
from orthonav.onboard.run import Locator, SingleViews

NAME = "tracking"
SIDES_M = (1000, 4000, 10000)
TURNS_EN_M = ((-330, -330), (-330, 300), (-60, 330), (60, -330), (330, -300), (330, 330))
"""A route over the inner kilometre, metres east and north of its centre."""
SPACING_M, AGL_M, SEED, RIGHT_M = 40.0, 150.0, 7, 15.0
HEADER = (
    *("area km2", "views", "method", "ms", "p99 ms", "found at view", "15 m", "median m"),
    "false",
)


def measure(options: argparse.Namespace) -> Section:
    """The same views over maps of growing size, followed and one by one."""
    present = area(options.work, PRESENT, side_m=SIDES_M[0])
    rows = []
    for side_m in SIDES_M[:1] if options.quick else SIDES_M:
        past = area(options.work, PAST, side_m=side_m)
        localizer = Localizer(open_map(map_of(past, options.work)))
        folder = _flown(options.work, localizer, present)
        locators: dict[str, Locator] = {
            "tracked": Tracker(localizer, use_prior=False),
            "one by one": SingleViews(localizer, use_prior=False),
        }
        for method, locator in locators.items():
            cells = _cells(localizer, folder, locator)
            rows.append([number((side_m / 1000) ** 2), cells[0], method, *cells[1:]])
            say("  ".join(rows[-1]))
    notes = (
        f"{AGL_M:g} m height, a view every {SPACING_M:g} m, 1 s apart, of another date, heading "
        "off by 5 deg and height by 5 % (standard deviations), no prior, whole map; one core",
        "found at view: the first that is tracking; 15 m, median, ms and p99 from there on (one by "
        "one: of all); false: confident and more than 35 m off",
    )
    return Section("Following a flight", [Table("Following a flight", HEADER, rows, notes)])


def _flown(work: Path, localizer: Localizer, present: Path) -> Path:
    folder = work / "followed"
    if not folder.is_dir():
        request = SimulateRequest(
            [present],
            folder,
            route=route_of(localizer.sheet.frame, np.array(TURNS_EN_M, np.float64)),
            agl_m=AGL_M,
            spacing_m=SPACING_M,
            errors=Errors(yaw_std_deg=5.0, agl_std=0.05),
            seed=SEED,
        )
        simulate_flight(request)
    return folder


def _cells(localizer: Localizer, folder: Path, locator: Locator) -> list[str]:
    results = list(localize_flight(locator, open_flight(folder)))
    truth, frame = read_truth(folder / "truth.csv"), localizer.sheet.frame
    errors, confident = np.full(len(results), np.inf), np.zeros(len(results), np.bool_)
    for i, each in enumerate(results):
        if isinstance(each.outcome, Fix):
            place = frame.en_from_latlon(each.outcome.lat_deg, each.outcome.lon_deg)
            errors[i] = np.hypot(*(place - frame.en_from_latlon(*truth[each.frame])))
            confident[i] = each.is_confident
    tracking = [i for i, each in enumerate(results) if each.state in (None, "tracking")]
    first = tracking[0] if tracking else len(results)
    warm = [each.latency_ms for each in results[max(first, 1) :]]  # the first prepares the map
    return [
        *(str(len(results)), *quantiles(warm, 50, 99)),
        "-" if results[0].state is None else str(first + 1),
        percent(float((errors[first:] <= RIGHT_M).mean())),
        *quantiles(errors[first:], 50),
        str(int((confident & (errors > FAR_M)).sum())),
    ]


if __name__ == "__main__":
    sys.exit(run(NAME, __doc__, measure))
