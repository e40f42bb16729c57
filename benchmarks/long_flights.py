"""Long flights followed over a map of another date: wind, drift, biases, clouds, kidnapping.

`python -m benchmarks.long_flights [--flights 20] [--km 50] [--quick] [--only N ..] [--work DIR]`
flies over a generated area, follows every flight with `Tracker` from no prior, and prints a table.
Area, map, flights and what came out of each flight stay in the work folder: an interrupted run
goes on where it ended, and `orthonav localize MAP FLIGHT --track --prior none --out fixes.jsonl`
replays one of them. `--only` repeats the named flights even if results exist.
"""

import argparse
import hashlib
import json
import math
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

import orthonav
from benchmarks.flights import read_rows, write_rows
from benchmarks.inputs import PAST, PRESENT, Workplace
from benchmarks.record import Section, Table, number, provenance, save, sources_digest
from benchmarks.verdicts import percent
from orthonav.core.files import replacing
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.geo.camera import Camera
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import CONFIDENT, Fix, ViewResult
from orthonav.core.track.tracker import Tracker
from orthonav.ground.evaluate.calibration import nees_bound, normalized_squared
from orthonav.ground.planning.route import Route
from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight
from orthonav.ground.simulate.motion import Wind
from orthonav.ground.simulate.render import Clouds
from orthonav.onboard.run import localize_flight

CAMERA = Camera(640, 480, 1000.0, 1000.0, 320.0, 240.0)
AGL_M, GSD_M, SPACING_M, SPEED_MPS, TURN_RADIUS_M = 2000.0, 2.5, 100.0, 25.0, 400.0
AREA_M, QUICK_AREA_M, BORDER_M = 12_000, 6_000, 1300.0
LEG_M, SHARPEST_DEG = (3000.0, 9000.0), 120.0
WIND_MPS, DRIFT, CLOUD_SHARE = 8.0, 0.02, 0.15
YAW_BIAS_DEG, AGL_BIAS = 3.0, 0.05
SCATTER = Errors(
    yaw_std_deg=1.0, agl_std=0.01, tilt_std_deg=0.2, attitude_std_deg=2.0, velocity_drift=DRIFT
)
GAP_M, JUMP_M = 3000.0, 2000.0
"""A kidnapped flight leaves out at least this path length and this straight distance."""
RIGHT_M, DIVERGED_M, DIVERGED_VIEWS = 35.0, 60.0, 10
SEED = 100
Array = NDArray[np.float64]
HEADER = (
    *("flight", "kidnapped", "views", "all: median m", "tracking from", "median m", "95 % m"),
    *(
        "max m",
        "confident",
        "confident and wrong",
        "diverged",
        "back after",
        "NEES",
        "below 5.99",
        "ms",
    ),
)
# What a map does not hang on.
_NOT_IN_MAPS = ("cli", "simulate", "evaluate", "onboard", "sources", "track", "publish")


@dataclass(frozen=True)
class Plan:
    """One flight: `kidnapped` is "" or how ("gap": the clock runs on, "jump": it does not)."""

    number: int
    km: float
    area_m: int

    @property
    def kidnapped(self) -> str:
        """Every third flight, the two ways in turn."""
        return ("gap", "jump")[self.number // 3 % 2] if self.number % 3 == 1 else ""

    @property
    def name(self) -> str:
        """Name of its files: other settings or another simulator, another name."""
        settings = repr((asdict(self), CAMERA, AGL_M, GSD_M, SPACING_M, TURN_RADIUS_M, SCATTER))
        digest = hashlib.sha256(settings.encode() + _digest("simulate").encode()).hexdigest()[:8]
        return f"flight-{self.number:02d}-{digest}"

    def rng(self) -> np.random.Generator:
        """Random generator for values drawn once per flight."""
        return np.random.default_rng([SEED, self.number])


def main(arguments: Sequence[str]) -> int:
    """Fly, follow, print and write the tables; returns the exit code."""
    options = _parser().parse_args(arguments)
    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    start, started = time.perf_counter(), provenance("long-flights")
    area_m = QUICK_AREA_M if options.quick else AREA_M
    options.work.mkdir(parents=True, exist_ok=True)
    place = Workplace(options.work, options.work / "data", options.quick)
    past, present = place.area(area_m, GSD_M, [PAST, PRESENT])
    localizer = Localizer(open_map(_map(options.work, place, past)))
    km = min(options.km, 8.0) if options.quick else options.km
    count = min(options.flights, 3) if options.quick else options.flights
    outcomes = []
    for index in options.only or range(count):
        plan = Plan(index, km, area_m)
        folder = _flown(options.work, plan, localizer, present)
        outcomes.append(_followed(options.work, plan, folder, localizer, bool(options.only)))
        took_s = time.perf_counter() - start
        print(f"{took_s:5.0f} s  {'  '.join(_row(outcomes[-1]))}", file=sys.stderr, flush=True)
    section = _section(outcomes, km, area_m)
    print(section.markdown())
    wall_s = time.perf_counter() - start
    paths = save(options.out, [section], started, wall_s=wall_s, latest=False)
    print(f"written to {', '.join(map(str, paths))}", file=sys.stderr)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.long_flights", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--flights", type=int, default=20, help="how many (default 20)")
    parser.add_argument("--km", type=float, default=50.0, help="length of each (default 50)")
    parser.add_argument("--quick", action="store_true", help="3 flights of 8 km, a smaller area")
    parser.add_argument(
        "--only", type=int, nargs="+", metavar="N", help="repeat these flights only"
    )
    parser.add_argument("--work", type=Path, default=Path("bench_results/long_flights"))
    parser.add_argument("--out", type=Path, default=Path("bench_results"))
    return parser


def _digest(*parts: str, but: Sequence[str] = ()) -> str:
    """Short digest of the package's sources, of named parts of it or all `but` some."""
    root, digest = Path(orthonav.__file__).parent, hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        inside = path.relative_to(root)
        tracker = but and inside.name == "tracker.py"
        if (not parts or inside.parts[0] in parts) and inside.parts[0] not in but and not tracker:
            digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


def _map(work: Path, place: Workplace, ortho: Path) -> Path:
    """The map with the defaults of `orthonav build`, built again when its sources changed."""
    maps = work / f"maps-{_digest(but=_NOT_IN_MAPS)}"
    maps.mkdir(exist_ok=True)
    return replace(place, scratch=maps).map(ortho)


def _flown(work: Path, plan: Plan, localizer: Localizer, ortho: Path) -> Path:
    """Folder of the flight, simulated if absent, with the drawn values in a file."""
    folder, about = work / plan.name, work / f"{plan.name}.plan.json"
    if about.is_file():
        return folder
    rng = plan.rng()
    line = random_legs(rng, plan.km * 1000, plan.area_m / 2 - BORDER_M)
    lat, lon = localizer.sheet.frame.latlon_from_en(line)
    yaw_bias, agl_bias = rng.normal(0, 1, 2) * [YAW_BIAS_DEG, AGL_BIAS]
    wind = Wind(WIND_MPS, float(rng.uniform(0, 360)))
    errors = replace(SCATTER, yaw_bias_deg=float(yaw_bias), agl_bias=float(agl_bias))
    seed = SEED + plan.number
    if not folder.is_dir():
        request = SimulateRequest(
            [ortho],
            folder,
            route=Route(tuple(zip(lat.tolist(), lon.tolist(), strict=True))),
            agl_m=AGL_M,
            spacing_m=SPACING_M,
            airspeed_mps=SPEED_MPS,
            camera=CAMERA,
            errors=errors,
            seed=seed,
            wind=wind,
            turn_radius_m=TURN_RADIUS_M,
            cloud_share=CLOUD_SHARE,
        )
        simulate_flight(request)
    names = list(read_truth(folder / "truth.csv"))
    clouds = Clouds(len(names), CLOUD_SHARE, seed)
    record: dict[str, Any] = {
        "yaw_bias_deg": errors.yaw_bias_deg,
        "agl_bias": errors.agl_bias,
        "wind_from_deg": wind.from_deg,
        "clouds": {name: round(clouds.degree(index), 3) for index, name in enumerate(names)},
        "first_after": _kidnap(folder, plan, localizer, rng) if plan.kidnapped else None,
    }
    with replacing(about) as temporary:
        temporary.write_text(json.dumps(record, indent=1), encoding="utf-8")
    return folder


def random_legs(
    rng: np.random.Generator, length_m: float, reach_m: float, leg_m: tuple[float, float] = LEG_M
) -> Array:
    """Corners (N, 2) of a route of random legs in a square, `length_m` long."""
    line = [rng.uniform(-reach_m, reach_m, 2)]
    course, left_m = rng.uniform(0, 2 * math.pi), length_m
    shortest = min(leg_m[0], reach_m)
    while left_m > 0:
        step = rng.uniform(-reach_m, reach_m, 2) - line[-1]
        drawn_m, new = float(np.hypot(*step)), math.atan2(step[1], step[0])
        turn_deg = abs(math.degrees(math.remainder(new - course, 2 * math.pi)))
        if not (shortest <= drawn_m <= leg_m[1] and turn_deg <= SHARPEST_DEG):
            course += 0.05  # leave the corner of the square
            continue
        line.append(line[-1] + step * min(1.0, left_m / drawn_m))
        course, left_m = new, left_m - drawn_m
    return np.array(line)


def _kidnap(folder: Path, plan: Plan, localizer: Localizer, rng: np.random.Generator) -> str:
    """Leave out views in the middle and the velocity over the gap; returns the first after it."""
    rows = read_rows(folder / "telemetry.csv")
    truth = read_truth(folder / "truth.csv")
    frame = localizer.sheet.frame
    places = np.array([frame.en_from_latlon(*truth[row["frame"]]) for row in rows])
    first = int(rng.uniform(0.4, 0.55) * len(rows))
    path_m = np.cumsum(np.hypot(*np.diff(places[first:], axis=0).T))
    apart = np.hypot(*(places[first + 1 :] - places[first]).T)
    after = first + 1 + int(np.argmax((path_m >= GAP_M) & (apart >= JUMP_M)))
    gap_s = float(rows[after]["time_s"]) - float(rows[first]["time_s"]) - SPACING_M / SPEED_MPS
    for row in rows[after:] if plan.kidnapped == "jump" else ():
        row["time_s"] = f"{float(row['time_s']) - gap_s:.6f}"
    rows[after]["vel_east_mps"] = rows[after]["vel_north_mps"] = ""
    gone = {row["frame"] for row in rows[first + 1 : after]}
    for name in ("telemetry.csv", "truth.csv"):
        table = rows if name == "telemetry.csv" else read_rows(folder / name)
        write_rows(folder / name, [row for row in table if row["frame"] not in gone])
    return rows[after]["frame"]


def _followed(
    work: Path, plan: Plan, folder: Path, localizer: Localizer, repeat: bool
) -> dict[str, Any]:
    """What came out view by view, read where this very program has followed the flight before."""
    path = work / f"{plan.name}.followed.json"
    if path.is_file() and not repeat:
        stored: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if stored["sources"] == sources_digest():
            return stored
    about = json.loads((work / f"{plan.name}.plan.json").read_text(encoding="utf-8"))
    sources, truth = sources_digest(), read_truth(folder / "truth.csv")
    placed = localize_flight(Tracker(localizer, use_prior=False), open_flight(folder))
    rows = [
        {**_record(each, localizer, truth[each.frame]), "clouds": about["clouds"][each.frame]}
        for each in placed
    ]
    followed = {
        "flight": plan.number,
        "kidnapped": plan.kidnapped,
        "first_after": about["first_after"],
        "sources": sources,
        "views": rows,
    }
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(followed, indent=1), encoding="utf-8")
    return followed


def _record(result: ViewResult, localizer: Localizer, truth: tuple[float, float]) -> dict[str, Any]:
    """One view for JSON: error east and north in m and stated values; None without a fix."""
    out = result.outcome
    record: dict[str, Any] = {
        "frame": result.frame,
        "time_s": result.time_ns / 1e9,
        "state": result.state,
        "ms": round(result.latency_ms, 2),
    }
    if not isinstance(out, Fix):
        return {**record, "reason": out.reason, "error_en_m": None, "confidence": None}
    frame = localizer.sheet.frame
    error = frame.en_from_latlon(out.lat_deg, out.lon_deg) - frame.en_from_latlon(*truth)
    return {
        **record,
        "error_en_m": error.tolist(),
        "confidence": out.confidence,
        "radius_m": out.radius_m,
        "cov_en_m2": out.cov_en_m2.tolist(),
        "evidence": dict(out.evidence),
    }


@dataclass(frozen=True, eq=False)
class Figures:
    """Views (N) of one flight or more in numbers, infinite errors where there is no fix."""

    errors_m: Array
    nees: Array
    tracking: NDArray[np.bool_]
    confident: NDArray[np.bool_]
    radius_m: Array
    ms: Array

    @classmethod
    def of(cls, views: Sequence[dict[str, Any]]) -> "Figures":
        """From the views of `_followed`."""
        known = np.array([view["error_en_m"] is not None for view in views])
        fixed = [view for view in views if view["error_en_m"] is not None]
        errors, nees = np.full(len(views), np.inf), np.full(len(views), np.nan)
        radius = np.full(len(views), np.nan)
        if fixed:
            off = np.array([view["error_en_m"] for view in fixed])
            cov = np.array([view["cov_en_m2"] for view in fixed])
            errors[known], nees[known] = np.hypot(*off.T), normalized_squared(off, cov)
            radius[known] = [view["radius_m"] for view in fixed]
        return cls(
            errors,
            nees,
            np.array([view["state"] == "tracking" for view in views]),
            np.array([(view["confidence"] or 0.0) >= CONFIDENT for view in views]),
            radius,
            np.array([view["ms"] for view in views]),
        )

    @property
    def median_m(self) -> float:
        """Median error of all views that have a position, tracking or not."""
        known = self.errors_m[np.isfinite(self.errors_m)]
        return float(np.median(known)) if known.size else math.nan

    @property
    def wrong(self) -> int:
        """Number of views that are confident and wrong."""
        far = self.errors_m > np.fmax(RIGHT_M, self.radius_m)
        return int((self.confident & far).sum())

    @property
    def divergences(self) -> int:
        """Stretches of more than `DIVERGED_VIEWS` tracking views that are `DIVERGED_M` off."""
        far = self.tracking & (self.errors_m > DIVERGED_M)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], far.astype(np.int8), [0]])))
        return int((np.diff(edges)[::2] > DIVERGED_VIEWS).sum())

    def cells(self) -> list[str]:
        """Median, 95 %, largest error while tracking; confident; wrong; divergences."""
        errors = self.errors_m[self.tracking]
        spread = np.percentile(errors, [50, 95, 100]) if errors.size else np.full(3, np.nan)
        confident = percent(float(self.confident.mean()))
        return [*map(number, spread), confident, str(self.wrong), str(self.divergences)]

    def consistency(self) -> list[str]:
        """Mean of the normalized errors squared while tracking, and the share below 5.991."""
        nees = self.nees[self.tracking]
        if not nees.size:
            return ["-", "-"]
        return [number(float(nees.mean())), percent(float((nees < nees_bound(0.95)).mean()))]


def _back_after(followed: dict[str, Any]) -> int | None:
    """Views from the first after a kidnapping to the first that is tracking and right."""
    views = followed["views"]
    first = [view["frame"] for view in views].index(followed["first_after"])
    figures = Figures.of(views[first:])
    right = np.flatnonzero(figures.tracking & (figures.errors_m <= RIGHT_M))
    return int(right[0]) + 1 if right.size else None


def _row(followed: dict[str, Any]) -> list[str]:
    figures = Figures.of(followed["views"])
    first = int(np.argmax(figures.tracking)) + 1 if figures.tracking.any() else None
    back = "-"
    if followed["kidnapped"]:
        back = str(_back_after(followed) or "never")
    return [
        str(followed["flight"]),
        followed["kidnapped"] or "-",
        str(len(figures.ms)),
        number(figures.median_m),
        str(first or "never"),
        *figures.cells(),
        back,
        *figures.consistency(),
        number(float(np.median(figures.ms))),
    ]


def _section(outcomes: Sequence[dict[str, Any]], km: float, area_m: int) -> Section:
    section = Section("Long flights")
    every = Figures.of([view for followed in outcomes for view in followed["views"]])
    data = f"generated {area_m} m square, {GSD_M:g} m"
    means = []
    for followed in outcomes:
        figures, name = Figures.of(followed["views"]), f"flight {followed['flight']}"
        if figures.tracking.any():
            errors, nees = figures.errors_m[figures.tracking], figures.nees[figures.tracking]
            section.add(f"{name}: error", "m", errors, data=data, seed=SEED)
            means.append(float(nees.mean()))
        section.add(f"{name}: time", "ms", figures.ms, data=data, seed=SEED)
    lost = [f for f in outcomes if f["kidnapped"]]
    found = sum(_back_after(followed) is not None for followed in lost)
    divergences = sum(Figures.of(followed["views"]).divergences for followed in outcomes)
    total = ["**all**", "", str(len(every.ms)), number(every.median_m), "", *every.cells()]
    total[-1] = str(divergences)
    back = f"{found} of {len(lost)}" if lost else "-"
    total += [back, *every.consistency(), number(float(np.median(every.ms)))]
    rows = [*map(_row, outcomes), total]
    notes = (*_notes(km), *_nees_notes(every, means))
    section.tables = [Table("Long flights", HEADER, rows, notes)]
    errors = every.errors_m[every.tracking]
    if errors.size:
        section.facts = {
            "long_median_m": float(np.median(errors)),
            "long_p95_m": float(np.percentile(errors, 95)),
            "long_nees": float(every.nees[every.tracking].mean()),
            "long_divergences": float(divergences),
            "long_not_recovered": float(len(lost) - found),
        }
    return section


def _nees_notes(every: Figures, means: Sequence[float]) -> list[str]:
    count = int(every.tracking.sum())
    if not count:
        return []
    low, high = chi2.ppf([0.025, 0.975], 2 * count) / count
    text = f"NEES of {count} views, were each independent: 95 % bounds {low:.2f} to {high:.2f}"
    if len(means) > 1:
        half = 1.96 * float(np.std(means, ddof=1)) / math.sqrt(len(means))
        text += f"; mean of the flights {np.mean(means):.2f} +- {half:.2f} (95 %), 2 is right"
    return [text]


def _notes(km: float) -> tuple[str, ...]:
    return (
        f"{km:g} km of random legs, turns of {TURN_RADIUS_M:g} m radius, {AGL_M:g} m above ground, "
        f"a view every {SPACING_M / SPEED_MPS:g} s (about {SPACING_M:g} m), over another date than "
        f"the map's; wind {WIND_MPS:g} m/s; reported velocity off by {DRIFT:.0%} of scale and "
        f"{DRIFT:g} rad; heading by {YAW_BIAS_DEG:g} deg, drawn once per flight, and "
        f"{SCATTER.yaw_std_deg:g} deg at every view; height by {AGL_BIAS:.0%} and "
        f"{SCATTER.agl_std:.0%}; tilt {SCATTER.attitude_std_deg:g} deg, reported with an error of "
        f"{SCATTER.tilt_std_deg:g} deg (all standard deviations); clouds over {CLOUD_SHARE:.0%} of "
        "the route; no prior, whole map, one core",
        f"kidnapped: {GAP_M / 1000:g} km or more left out in the middle, no velocity reported; "
        "gap: the clock runs on, jump: it does not; back after: views until tracking and within "
        f"{RIGHT_M:g} m again",
        "all: median: of views that have a position; median, 95 %, max, NEES: of tracking views; "
        "confident: confidence of 0.9 or more, of all views; "
        f"wrong: more than {RIGHT_M:g} m and the stated radius off; diverged: more than "
        f"{DIVERGED_VIEWS} tracking views in a row more than {DIVERGED_M:g} m off",
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
