"""Stages of a registered view, and the floor of its FFTs."""

import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np

from benchmarks.flights import Flight
from benchmarks.inputs import FLIGHT_SEED, PAST, PRESENT, WIDE_ERRORS, Workplace
from benchmarks.machine import reading_gb_per_s, seconds
from benchmarks.record import Section, Table, number
from orthonav.core.localize import Localizer
from orthonav.core.localize import localizer as fixes
from orthonav.core.localize import place as places
from orthonav.core.localize import search as steps
from orthonav.core.mapfile import open_map
from orthonav.core.register import refine
from orthonav.core.register.search import search

FORWARD, BACKWARD = 3, 1
"""FFTs of a pose: one per channel of evidence, and one of the sum of products."""
LEAST_RUNS = 15
REST, VERIFY, WHOLE = "the rest", "templates and verdict", "**whole `locate`**"
Search = tuple[int, tuple[int, int], int]
"""Level, size of the FFT, poses."""


@dataclass
class _Account:
    """Milliseconds of one view by stage, each without the stages inside it; searches made."""

    stages: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    searches: list[Search] = field(default_factory=list)
    _inside_ms: list[float] = field(default_factory=lambda: [0.0])

    def around(self, name: Callable[..., str], function: Callable[..., Any]) -> Callable[..., Any]:
        """`function`, its time added to the stage that `name` makes of its arguments."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            self._inside_ms.append(0.0)
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                took_ms = 1e3 * (time.perf_counter() - start)
                self.stages[name(*args, **kwargs)] += took_ms - self._inside_ms.pop()
                self._inside_ms[-1] += took_ms

        return timed


def measure(place: Workplace) -> Section:
    """Stages of views with known and unknown heading; FFT floors of the searches they made."""
    section = Section("Time of a registered view")
    past, present = place.area(2000, 1.0, [PAST, PRESENT])
    localizer = Localizer(open_map(place.map(past)))
    flight = place.fly(present, 12 if place.quick else 100, WIDE_ERRORS)
    searches: dict[Search, int] = defaultdict(int)
    columns = {}
    for known in (True, False):
        views = flight.views if known else flight.views[: max(4, len(flight.views) // 4)]
        taken = Flight(flight.folder, flight.camera, views)
        columns[known] = _accounts(localizer, taken, known, searches)
    section.tables = [_stages(section, columns), _floors(section, searches)]
    return section


def _accounts(
    localizer: Localizer, flight: Flight, known: bool, searches: dict[Search, int]
) -> list[_Account]:
    first = flight.views[0]
    localizer.locate(first.view, heading_known=known)  # warm-up
    accounts = []
    for flown in flight.views:
        with _watched(_Account()) as account:
            locate = account.around(lambda *a, **k: REST, localizer.locate)
            locate(flown.view, heading_known=known)
        accounts.append(account)
        for each in account.searches:
            searches[each] += 1
    return accounts


@contextmanager
def _watched(account: _Account) -> Iterator[_Account]:
    """Clocks around the stages of registration."""
    locate, refiner = fixes.RegistrationLocalizer, refine.Refiner

    def searched(template: Any, window: Any, poses: Any, *rest: Any) -> Any:
        account.searches.append((template.level, tuple(window.size), len(poses)))
        return search(template, window, poses, *rest)

    clocked = [
        (locate, "prepared", lambda *a, **k: "rectify"),
        (steps.FftStep, "run", _kind),
        (steps.TileStep, "run", _kind),
        (places.Placer, "judge", lambda *a, **k: VERIFY),
        (places.Placer, "finished", lambda *a, **k: VERIFY),
        (refiner, "place", lambda self, *a, **k: f"refine, level {self.template.level}"),
    ]
    with ExitStack() as stack:
        for owner, name, stage in clocked:
            timed = account.around(stage, getattr(owner, name))
            stack.enter_context(patch.object(owner, name, timed))
        stack.enter_context(patch.object(steps, "search", searched))
        yield account


def _kind(step: steps.Step) -> str:
    return "search, " + ("tiles" if step.from_tiles else f"level {step.level}")


def _stages(section: Section, columns: dict[bool, list[_Account]]) -> Table:
    found = {name for accounts in columns.values() for each in accounts for name in each.stages}
    names = [*sorted(found - {VERIFY, REST}), VERIFY, REST, WHOLE]
    lists = {known: _lists(accounts, names) for known, accounts in columns.items()}
    rows = []
    for name in names:
        cells = []
        for known, figures in lists.items():
            words = f"{name}, heading {'known' if known else 'unknown'}"
            made = section.add(
                words, "ms", figures[name], data="generated 2 x 2 km, 1 m", seed=FLIGHT_SEED
            )
            share = sum(figures[name]) / sum(figures[WHOLE])
            cells += [number(made.median), number(float(np.mean(figures[name]))), f"{share:.0%}"]
        rows.append([name, *cells])
    header: tuple[str, ...] = ("stage", "known: median ms", "mean ms", "share")
    header += ("unknown: median ms", "mean ms", "share")
    notes = (
        f"generated 2 x 2 km at 1 m; heading known to 10 deg ({len(columns[True])} views) and "
        f"unknown ({len(columns[False])}); height known to 10 %; warm, one core; a view that is "
        "not confident after one search is searched again, so the mean is more useful than the "
        "median; share: of the time of all views",
        "level n: pixels of 2^n m; rectify: checks, thinning, rectification; search, tiles: "
        "candidates from embeddings, and their best places near by; refine: all candidates that "
        "reach the level; templates: evidence of the view and its derivatives; no overlap",
    )
    return Table("Stages of a registered view", header, rows, notes)


def _lists(accounts: list[_Account], names: list[str]) -> dict[str, list[float]]:
    """Milliseconds of every stage, a number for each view."""
    figures = {name: [each.stages.get(name, 0.0) for each in accounts] for name in names}
    figures[WHOLE] = [sum(each.stages.values()) for each in accounts]
    return figures


def _floors(section: Section, searches: dict[Search, int]) -> Table:
    """Time of the FFTs of each search alone."""
    common: dict[Search, int] = {}
    for key in sorted(searches, key=lambda key: -searches[key]):
        if not any(key[0] == seen[0] and key[2] == seen[2] for seen in common):
            common[key] = searches[key]
    rows = []
    for (level, size, poses), count in sorted(common.items()):
        pixels = size[0] * size[1]
        flops = (FORWARD + BACKWARD) * 2.5 * pixels * math.log2(pixels) + 3 * FORWARD * pixels
        touched = 4 * pixels * (2 * (FORWARD + BACKWARD) + 3 * FORWARD)
        fft_ms = _fft_ms(size)
        name = f"level {level}, {size[0]} x {size[1]} px"
        data = "random numbers"
        section.add(f"{name}: forward FFT", "ms", [fft_ms[0]], data=data)
        section.add(f"{name}: backward FFT", "ms", [fft_ms[1]], data=data)
        pose_ms = FORWARD * fft_ms[0] + BACKWARD * fft_ms[1]
        gb_per_s = reading_gb_per_s(4 * pixels)
        rows.append(
            [
                name,
                *(str(poses), str(count), number(flops / 1e6), number(touched / 1e6)),
                *(number(touched / gb_per_s / 1e6), number(pose_ms)),
                *(number(flops / pose_ms / 1e6), number(poses * pose_ms)),
            ]
        )
    header: tuple[str, ...] = ("FFT of", "poses", "searches", "MFLOP a pose", "MB a pose")
    header += ("bytes' floor ms", "bare FFTs of a pose ms", "GFLOP/s", "all poses ms")
    notes = (
        f"a pose: {FORWARD} forward and {BACKWARD} backward real FFTs, 2.5 N log2 N each (half of "
        f"a complex one), and {FORWARD} products of spectra; bytes: every plane read and written "
        "once per FFT, two read and one written per product; their floor: at the rate one core "
        "reads an array of that size",
        "bare FFTs: `cv2.dft` and `cv2.idft` of random numbers of that size, in memory used "
        "before, one core; all poses: the floor of the search with the FFTs as they are",
        "searches: how many of the views above were searched so; only the commonest size of each "
        "level and bank is listed",
    )
    return Table("Floor of the search", header, rows, notes)


def _fft_ms(size: tuple[int, int]) -> tuple[float, float]:
    """Median milliseconds of one forward and one backward real FFT."""
    plane = np.random.default_rng(0).random(size, dtype=np.float32)
    made, back = np.empty_like(plane), np.empty_like(plane)
    flags = cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT

    def forward() -> None:
        cv2.dft(plane, dst=made)

    def backward() -> None:
        cv2.idft(made, dst=back, flags=flags)

    forward_s, backward_s = (
        float(np.median([seconds(run) for _ in range(LEAST_RUNS)])) for run in (forward, backward)
    )
    return 1e3 * forward_s, 1e3 * backward_s
