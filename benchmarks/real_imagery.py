"""Views of another date and recorded flights, localized on real imagery one by one.

`python -m benchmarks.real_imagery [--views 200] [--seed 1] [--only NAME ..]`. Maps are those of
`orthonav build`. Imagery that is absent is left out with a line that says so.
"""

import argparse
import sys
from dataclasses import dataclass
from itertools import islice

from benchmarks.placing import views_in
from benchmarks.record import Section, Table, number, percent, quantiles, run, say
from benchmarks.scenes import DATA, FAR_M, SCENES, Pair, localizer_of, simulated_views
from benchmarks.verdicts import Verdict, placed
from orthonav.core.records import CONFIDENT
from orthonav.onboard.run import SingleViews

NAME = "real_imagery"
GROUPS = ("naip", "airchange", "taichung", "arroio")
HEADER = (
    *("map > views", "n", "near", "35 m", "median m", "correct and accepted"),
    *("false of accepted", "ECE", "NEES", "ms", "p99 ms"),
)


@dataclass(frozen=True)
class Row:
    """A map and what flies over it: an orthophoto of another date, or a recorded flight."""

    group: str
    pair: Pair
    near_m: float = 15.0
    heading_known: bool = True


def rows() -> list[Row]:
    """All rows, those of one map together."""
    naip, szada = SCENES["naip"], [SCENES[f"szada_{n}"] for n in ("1", "5", "7", "mosaic")]
    pairs = [naip.pair(naip.dates[0], date) for date in naip.dates[1:]]
    made = [Row("naip", pair, heading_known=known) for known in (True, False) for pair in pairs]
    made += [Row("airchange", each.pair(*each.dates)) for each in szada]
    taichung = Pair("taichung", "taichung_drone/map.tif", "taichung_drone", 0.2)
    arroio = (f"arroio_maps/{month}.tif" for month in ("2014-01", "2014-03"))
    flown = [Pair("arroio", name, "arroio_drone_1", 0.243) for name in arroio]
    return [*made, Row("taichung", taichung, 35.0), *(Row("arroio", each, 25.0) for each in flown)]


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--views", type=int, default=200, help="views per simulated flight")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=GROUPS, default=GROUPS, help="only these")


def measure(options: argparse.Namespace) -> Section:
    section, cells = Section("Real imagery"), []
    count = 6 if options.quick else options.views
    for row in rows():
        if row.group in options.only and row.pair.is_there:
            localizer = localizer_of(row.pair.map, options.work)
            locator = SingleViews(localizer, use_prior=False, heading_known=row.heading_known)
            views = views_in(DATA / row.pair.views)
            if row.pair.views.endswith(".tif"):
                views = simulated_views(row.pair, options.work, views=count, seed=options.seed)
            if options.quick:
                views = islice(views, count)
            verdict = placed(locator, views, localizer.sheet.frame)
            cells.append(_cells(row, verdict))
            say("  ".join(cells[-1]))
    notes = (
        f"whole map, no prior, seed {options.seed}; simulated flights: heading off by 10 deg and "
        "height by 10 % (standard deviations), a mount and a horizon of 1 deg each, not reported",
        "near: within 15 m, Taichung 35 m, Arroio 25 m; correct and accepted: confidence of "
        f"{CONFIDENT:g} or more, of the views within {FAR_M:g} m; false: more than {FAR_M:g} m "
        "off; NEES: of correct fixes, 2 if the covariance is right; one core, warm",
    )
    if cells:
        section.tables.append(Table("Views of another date", HEADER, cells, notes))
    return section


def _cells(row: Row, verdict: Verdict) -> list[str]:
    heading = "" if row.heading_known else ", heading unknown"
    return [
        row.pair.name + heading,
        str(len(verdict.times_ms)),
        percent(float(verdict.within(row.near_m).mean()), 1),
        percent(float(verdict.within(FAR_M).mean()), 1),
        number(verdict.median_m),
        percent(verdict.accepted_of_right(FAR_M), 1),
        f"{verdict.wrong_accepted} of {int(verdict.accepted.sum())}",
        f"{verdict.ece:.3f}",
        number(verdict.nees_mean),
        *quantiles(verdict.times_ms, 50, 99),
    ]


if __name__ == "__main__":
    sys.exit(run(NAME, __doc__, measure, add))
