"""orthonav beside what a user would write first: same views, same run, same seeds."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines import Method, Orthonav, Reference, SiftMatch, TemplateMatch
from benchmarks.inputs import (
    FLIGHT_SEED,
    NAIP_ABSENT,
    NAIP_PAST,
    NAIP_PRESENT,
    NO_ERRORS,
    PAST,
    PRESENT,
    USUAL_ERRORS,
    Flight,
    Workplace,
    naip,
)
from benchmarks.machine import seconds
from benchmarks.record import Section, Table, number
from orthonav.localizer import Localizer
from orthonav.mapfile import open_map
from orthonav.simulate.flight import Errors

TURNS_DEG = (-6.0, 0.0, 6.0)
CONTROL_VIEWS = 10
RADII = ("0.75 stride", "1 stride", "15 m")
NOTES = (
    "shares of all views, whole map, no prior, whatever the confidence; a view without an answer "
    "counts as wrong; ms: median per view on one core, decoded view to position",
    "carried: what must be aboard for this area; bold: better than orthonav's default",
)


@dataclass(frozen=True)
class Scene:
    """One map and one flight over it; `kind` says what was told."""

    name: str
    past: Path
    present: Path
    errors: Errors
    kind: str
    views: int

    @property
    def title(self) -> str:
        """The scene in one line."""
        return f"{self.name}, {self.kind}"


@dataclass(frozen=True, eq=False)
class Result:
    """How one method did: `errors_m` (N,) infinite where there was no answer."""

    method: Method
    errors_m: NDArray[np.float64]
    times_ms: NDArray[np.float64]
    strides_m: float

    @property
    def shares(self) -> list[float]:
        """Share of views within each of `RADII`."""
        return [float((self.errors_m <= radius).mean()) for radius in self.radii_m]

    @property
    def radii_m(self) -> tuple[float, float, float]:
        """`RADII` in metres."""
        return 0.75 * self.strides_m, self.strides_m, 15.0


def measure(place: Workplace) -> Section:
    """Every method on every scene; then the scenes and figures where orthonav loses."""
    section = Section("Beside the methods a user would write first")
    losses = []
    for scene in _scenes(place):
        results = _results(place, scene)
        section.tables.append(_table(section, scene, results))
        losses += _losses(scene, results)
    if naip(NAIP_PRESENT) is None:
        losses.append([NAIP_ABSENT, "-", "-", "-"])
    header = ("scene: method", "figure", "method", "orthonav")
    note = "largest differences may be chance where n is small: intervals are in the JSON"
    section.tables.append(Table("Where another method beats orthonav", header, losses, (note,)))
    return section


def _scenes(place: Workplace) -> list[Scene]:
    generated = place.area(2000, 1.0, [PAST, PRESENT])
    pairs = [("Generated 2 x 2 km, 1 m, 2016-07 against 2021-10", *generated)]
    real = naip(NAIP_PAST), naip(NAIP_PRESENT)
    if real[0] and real[1]:
        pairs.append(("NAIP 4.7 x 3.6 km, 5 m, 2009 against 2018", real[0], real[1]))
    off, exact = "heading off by 5 deg, height by 5 % (sd)", "heading and height exact"
    scenes = [
        Scene(name, past, present, errors, kind, place.views)
        for name, past, present in pairs
        for errors, kind in ((USUAL_ERRORS, off), (NO_ERRORS, exact))
    ]
    control = f"same date, {exact} (control: all should be right)"
    past = generated[0]
    name = "Generated 2 x 2 km, 1 m, 2016-07 against itself"
    return [*scenes, Scene(name, past, past, NO_ERRORS, control, CONTROL_VIEWS)]


def _results(place: Workplace, scene: Scene) -> list[Result]:
    flight = place.fly(scene.present, scene.views, scene.errors)
    methods: list[Method] = []
    for edges, overlap in (("gradient", 0.875), ("gradient", 0.96875), *_ABLATIONS):
        path = place.map(scene.past, edges, overlap)
        name = f"orthonav --edges {edges}" if edges != "gradient" else "orthonav (default)"
        name += f" --overlap {overlap}" if overlap != 0.875 else ""
        methods.append(Orthonav(name, Localizer(open_map(path)), path.stat().st_size))
    localizer = Localizer(open_map(place.map(scene.past)))
    reference = Reference.of(scene.past, localizer)
    turns: list[Sequence[float]] = [(0.0,)]
    if scene.errors is USUAL_ERRORS:
        turns.append(TURNS_DEG)
    methods += [
        TemplateMatch(reference, canny=canny, turns_deg=turn)
        for canny in (False, True)
        for turn in turns
    ]
    methods.append(SiftMatch(reference))
    return [_run(method, flight, localizer) for method in methods]


_ABLATIONS = (("gray", 0.875), ("canny", 0.875))


def _run(method: Method, flight: Flight, localizer: Localizer) -> Result:
    errors_m, times_ms = [], []
    method.locate(flight.camera, flight.views[0])  # warm-up
    for view in flight.views:
        found: list[NDArray[np.float64] | None] = []
        times_ms.append(1e3 * seconds(lambda v=view: found.append(method.locate(flight.camera, v))))  # type: ignore[misc]
        truth = localizer.sheet.frame.en_from_latlon(*view.truth_latlon_deg)
        place = found[0]
        errors_m.append(np.inf if place is None else float(np.hypot(*(place - truth))))
    return Result(method, np.array(errors_m), np.array(times_ms), localizer.grid.stride_m)


def _table(section: Section, scene: Scene, results: Sequence[Result]) -> Table:
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
    stride_m = results[0].strides_m
    about = f"n = {len(results[0].errors_m)} views, stride {number(stride_m)} m"
    return Table(scene.title, header, rows, (about, *NOTES, *_imagery_note(results)))


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
        name = f"{scene.title}: {result.method.name}"
        for radius, share, own in zip(RADII, result.shares, default.shares, strict=True):
            if share > own:
                rows.append([name, f"within {radius}", f"{share:.0%}", f"{own:.0%}"])
        time_ms, own_ms = float(np.median(result.times_ms)), float(np.median(default.times_ms))
        if time_ms < own_ms:
            rows.append([name, "ms per view", number(time_ms), number(own_ms)])
        size, own_size = result.method.carried[1], default.method.carried[1]
        if size < own_size:
            rows.append([name, "carried MB", number(size / 1e6), number(own_size / 1e6)])
    return rows
