"""orthonav compared with first-choice methods: same views, same run, same seeds."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines import Method, Orthonav, Reference, SiftMatch, TemplateMatch
from benchmarks.flights import Flight
from benchmarks.inputs import (
    FLIGHT_SEED,
    NAIP_ABSENT,
    NAIP_PAST,
    NAIP_PRESENT,
    NO_ERRORS,
    PAST,
    PRESENT,
    USUAL_ERRORS,
    Workplace,
    naip,
)
from benchmarks.machine import timed
from benchmarks.record import Section, Table, number
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.ground.simulate.flight import Errors

TURNS_DEG = (-6.0, 0.0, 6.0)
CONTROL_VIEWS = 10
DENSER = 0.9375
OFF, EXACT = "heading off by 5 deg, height by 5 % (sd)", "heading and height exact"
RADII = ("0.75 stride", "1 stride", "15 m")
NOTES = (
    "shares of all views, whole map, no prior, whatever the confidence; a view without an answer "
    "counts as wrong; ms: median per view on one core, decoded view to position",
    "carried: what must be aboard for this area; bold: better than orthonav's default",
)


@dataclass(frozen=True)
class Scene:
    """One map and one flight over it; `kind` says how good the telemetry is."""

    area: str
    kind: str
    past: Path
    present: Path
    errors: Errors
    views: int

    @property
    def title(self) -> str:
        """The scene in one line."""
        return f"{self.area}: {self.kind}"


@dataclass(frozen=True, eq=False)
class Result:
    """How one method did: `errors_m` (N,) infinite where there was no answer."""

    method: Method
    errors_m: NDArray[np.float64]
    times_ms: NDArray[np.float64]
    stride_m: float

    @property
    def shares(self) -> list[float]:
        """Share of views within each of `RADII`."""
        return [float((self.errors_m <= radius).mean()) for radius in self.radii_m]

    @property
    def radii_m(self) -> tuple[float, float, float]:
        """`RADII` in metres."""
        return 0.75 * self.stride_m, self.stride_m, 15.0


def measure(place: Workplace) -> Section:
    """Every method on every scene; then the scenes and figures where orthonav loses."""
    section = Section("Comparison with first-choice methods")
    losses = []
    scenes = _scenes(place)
    for past in dict.fromkeys(scene.past for scene in scenes):
        methods = _methods(place, past)
        for scene in scenes:
            if scene.past == past:
                results = _results(place, scene, methods)
                notes = () if section.tables else NOTES
                section.tables.append(_table(section, scene, results, notes))
                losses += _losses(scene, results)
    if naip(NAIP_PRESENT) is None:
        losses.append([NAIP_ABSENT, "-", "-", "-", "-"])
    header = ("scene", "method", "figure", "method's", "orthonav's")
    note = (
        f"with {place.views} views a share is known to about "
        f"{1.28 * 50 / place.views**0.5:.0f} points (80 % interval); intervals are in the JSON"
    )
    section.tables.append(Table("Where another method beats orthonav", header, losses, (note,)))
    return section


def _scenes(place: Workplace) -> list[Scene]:
    past, present = place.area(2000, 1.0, [PAST, PRESENT])
    name = "Generated 2 x 2 km, 1 m, 2016 to 2021"
    scenes = [Scene(name, OFF, past, present, USUAL_ERRORS, place.views)]
    if not place.quick:
        scenes.append(Scene(name, EXACT, past, present, NO_ERRORS, place.views))
    scenes.append(
        Scene("Control, generated, same date", EXACT, past, past, NO_ERRORS, CONTROL_VIEWS)
    )
    real_past, real_present = naip(NAIP_PAST), naip(NAIP_PRESENT)
    if real_past and real_present:
        name = "NAIP 4.7 x 3.6 km, 5 m, 2009 to 2018"
        scenes.append(Scene(name, OFF, real_past, real_present, USUAL_ERRORS, place.views))
        if not place.quick:
            scenes.append(Scene(name, EXACT, real_past, real_present, NO_ERRORS, place.views))
    return scenes


def _methods(place: Workplace, past: Path) -> list[Method]:
    """All methods on one orthophoto, orthonav's default first."""
    builds = [("gradient", 0.875), ("gray", 0.875), ("canny", 0.875)]
    if not place.quick:
        builds.insert(1, ("gradient", DENSER))
    path = place.map(past)
    default = Orthonav("orthonav (default)", Localizer(open_map(path)), path.stat().st_size)
    methods: list[Method] = [default]
    for edges, overlap in builds:
        path = place.map(past, edges, overlap, registration=False)
        name = "embedding only" + (f", --edges {edges}" if edges != "gradient" else "")
        if overlap == DENSER:
            name += f", --overlap {overlap}"
        localizer = Localizer(open_map(path), registration=False)
        methods.append(Orthonav(f"orthonav, {name}", localizer, path.stat().st_size))
    reference = Reference.of(past, Localizer(open_map(place.map(past))))
    turns: tuple[Sequence[float], ...] = ((0.0,), TURNS_DEG)
    methods += [
        TemplateMatch(reference, canny=canny, turns_deg=turn)
        for canny in (False, True)
        for turn in turns
    ]
    return [*methods, SiftMatch(reference)]


def _results(place: Workplace, scene: Scene, methods: Sequence[Method]) -> list[Result]:
    flight = place.fly(scene.present, scene.views, scene.errors)
    localizer = Localizer(open_map(place.map(scene.past)))
    exact = scene.errors is NO_ERRORS
    return [
        _run(method, flight, localizer)
        for method in methods
        if not (exact and isinstance(method, TemplateMatch) and len(method.turns_deg) > 1)
    ]


def _run(method: Method, flight: Flight, localizer: Localizer) -> Result:
    errors_m, times_ms = [], []
    method.locate(flight.views[0].view)  # warm-up
    for flown in flight.views:
        place, took_s = timed(method.locate, flown.view)
        times_ms.append(1e3 * took_s)
        truth = localizer.sheet.frame.en_from_latlon(*flown.truth_latlon_deg)
        errors_m.append(np.inf if place is None else float(np.hypot(*(place - truth))))
    return Result(method, np.array(errors_m), np.array(times_ms), localizer.grid.stride_m)


def _table(
    section: Section, scene: Scene, results: Sequence[Result], notes: Sequence[str]
) -> Table:
    rows = []
    for result in results:
        name, seed = f"{scene.title}: {result.method.name}", FLIGHT_SEED
        for radius, limit_m in zip(RADII, result.radii_m, strict=True):
            hits = result.errors_m <= limit_m
            section.add_share(f"{name}: within {radius}", hits, data=scene.title, seed=seed)
        time = section.add(f"{name}: time", "ms", result.times_ms, data=scene.title, seed=seed)
        what, size_bytes = result.method.carried
        section.add(f"{name}: carried", "MB", [size_bytes / 1e6], data=scene.title, seed=seed)
        shares = [
            f"**{share:.0%}**" if share > best else f"{share:.0%}"
            for share, best in zip(result.shares, results[0].shares, strict=True)
        ]
        right = result.errors_m[result.errors_m <= result.radii_m[1]]
        median = number(float(np.median(right))) if len(right) else "-"
        none = f"{np.isinf(result.errors_m).mean():.0%}"
        carried = f"{number(size_bytes / 1e6)} ({what})"
        rows.append([result.method.name, *shares, median, none, number(time.median), carried])
    header = ("method", *RADII, "median error if right, m", "no answer", "ms", "carried MB")
    stride_m = results[0].stride_m
    about = f"n = {len(results[0].errors_m)} views, stride {number(stride_m)} m"
    return Table(scene.title, header, rows, (about, *_imagery_note(results), *notes))


def _imagery_note(results: Sequence[Result]) -> list[str]:
    for result in results:
        if isinstance(result.method, TemplateMatch):
            png = result.method.reference.png_bytes / 1e6
            return [f"the grey orthophoto without loss (PNG): {number(png)} MB"]
    return []


def _losses(scene: Scene, results: Sequence[Result]) -> list[list[str]]:
    """Rows where a method not of orthonav beats its default in a share, in time or in size."""
    default = results[0]
    rows = []
    for result in results:
        if isinstance(result.method, Orthonav):
            continue
        head = [scene.title, result.method.name]
        for radius, share, own in zip(RADII, result.shares, default.shares, strict=True):
            if share > own:
                rows.append([*head, f"within {radius}", f"{share:.0%}", f"{own:.0%}"])
        time_ms, own_ms = float(np.median(result.times_ms)), float(np.median(default.times_ms))
        if time_ms < own_ms:
            rows.append([*head, "ms per view", number(time_ms), number(own_ms)])
        size, own_size = result.method.carried[1], default.method.carried[1]
        if size < own_size and scene.errors is USUAL_ERRORS:  # does not depend on the telemetry
            rows.append([*head, "carried MB", number(size / 1e6), number(own_size / 1e6)])
    return rows
