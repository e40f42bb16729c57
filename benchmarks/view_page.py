"""The page of `orthonav view` with many views, in a real browser: opened, stepped, moved."""

import csv
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser, Page

from benchmarks.browser import HOW_TO_GET_ONE, chromium, started
from benchmarks.inputs import PAST, Workplace
from benchmarks.record import Section, Table, number
from orthonav.core.flight.fixes import write_results
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix, NoFix, ViewResult

SIDE_M = 1000
VIEWS = (1000, 10_000, 20_000)
SEED = 3
SCREEN = (1366, 768)
STEPS, MOVES, WHEELS = 40, 90, 12
OPENINGS = 5
PAUSE_MS = 150
MOST_WAIT_S = 120.0
WRONG_SHARE, NO_FIX_SHARE, CHANGE_SHARE = 0.02, 0.05, 0.01

MOVING_HEADER = (
    *("views", "", "median ms", "p10", "p90", "largest"),
    *("screen", "tasks > 50 ms", "longest ms"),
)

WATCH = """
(() => {
  const seen = { opened: 0, frames: [], tasks: [], steps: [], shown: [] };
  window.orthonavSeen = seen;
  new PerformanceObserver((list) => {
    seen.tasks.push(...list.getEntries().map((task) => task.duration));
  }).observe({ type: "longtask" });
  new PerformanceObserver((list) => {
    const keys = list.getEntries().filter((event) => event.name === "keydown");
    seen.shown.push(...keys.map((event) => event.duration));
  }).observe({ type: "event", durationThreshold: 16 });
  const drawn = (then) => requestAnimationFrame(() => {
    const { port1, port2 } = new MessageChannel();
    port1.onmessage = () => then(performance.now());
    port2.postMessage(0);
  });
  let before = 0;
  let found = false;
  const frame = (now) => {
    if (before) seen.frames.push(now - before);
    before = now;
    if (!found && document.querySelector("#list [aria-current]")) {
      found = true;
      drawn((at) => { seen.opened = at; });
    }
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
  addEventListener("keydown", ({ timeStamp }) => {
    drawn((at) => seen.steps.push(at - timeStamp));
  }, true);
})();
"""
"""Frames by their distance, tasks above 50 ms, from a key to its frame and to the screen."""


@dataclass(frozen=True)
class LongRun:
    """Paths of a run without pictures."""

    fixes: Path
    truth: Path


def write_long_run(
    folder: Path, count: int, frame: LocalFrame, middle_en_m: tuple[float, float], reach_m: float
) -> LongRun:
    """Looped flight, one view per second: most fixes correct, a few confident but wrong.

    `reach_m`: how far from the middle, in metres, the looped_flight go.
    """
    rng = np.random.default_rng(SEED)
    angle = np.linspace(0.0, 2 * np.pi * count / 900, count)
    radius_m = reach_m * (0.7 + 0.3 * np.cos(angle / 5.3))
    truth_en_m = np.stack([radius_m * np.cos(angle), radius_m * np.sin(1.01 * angle)], axis=1)
    truth_en_m += middle_en_m
    far = rng.random(count) < WRONG_SHARE
    fixes_en_m = truth_en_m + rng.normal(0.0, np.where(far, 60.0, 3.0)[:, None], (count, 2))
    lat, lon = frame.latlon_from_en(fixes_en_m)
    states = ("searching", "tracking", "tracking", "lost")
    state = states[0]
    results = []
    for i in range(count):
        if rng.random() < CHANGE_SHARE:
            state = states[rng.integers(len(states))]
        outcome: Fix | NoFix = NoFix("blank", "there is nothing to see")
        if rng.random() >= NO_FIX_SHARE:
            size = rng.uniform(2.0, 8.0)
            cov = np.array([[size**2, 0.4 * size], [0.4 * size, 4.0]])
            confidence = float(rng.beta(9.0, 1.0))
            outcome = Fix(float(lat[i]), float(lon[i]), cov, confidence, 35.0, 40.0, 120.0, {})
        results.append(ViewResult(_name(i), (100 + i) * 10**9, outcome, 25.0, state))
    run = LongRun(folder / f"{count}.jsonl", folder / f"{count}.csv")
    write_results(run.fixes, results)
    true_lat, true_lon = frame.latlon_from_en(truth_en_m)
    with run.truth.open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["frame", "lat_deg", "lon_deg"])
        for i in range(count):
            rows.writerow([_name(i), repr(float(true_lat[i])), repr(float(true_lon[i]))])
    return run


def _name(i: int) -> str:
    return f"{i:06d}.jpg"


def measure(place: Workplace) -> Section:
    """A row for each number of views; no rows without a browser."""
    section = Section("The page of a run")
    if chromium() is None:
        section.tables = [Table(section.title, ("views",), [], [HOW_TO_GET_ONE])]
        return section
    map_path = place.map(place.area(SIDE_M, 1.0, [PAST])[0])
    sheet = open_map(map_path).manifest.sheets[0]
    grid = sheet.grid
    middle_en_m = (
        grid.west_m + grid.width_px * grid.gsd_m / 2,
        grid.north_m - grid.height_px * grid.gsd_m / 2,
    )
    opening, moving = [], []
    with started() as browser:
        for count in VIEWS[:2] if place.quick else VIEWS:
            run = write_long_run(place.scratch, count, sheet.frame, middle_en_m, SIDE_M / 2.5)
            with _served(run, map_path) as (address, served_s):
                opening.append(_opening(section, browser, address, count, served_s))
                moving += _moving(section, browser, address, count)
        about = f"Chromium {browser.version} without a window and without a graphics card"
    notes = (
        f"{about}, {SCREEN[0]} x {SCREEN[1]}; server, browser and the program that presses the "
        f"keys share {_cores()}",
        "server: `orthonav view` from its start to its address; opened: from asking for the page "
        "to the frame in which map, list and course are drawn; no pictures",
    )
    header = ("views", "server s", "opened s", "p10", "p90", "JSON MB", "heap MB", "elements")
    section.tables.append(Table("Opening", header, opening, notes))
    section.tables.append(
        Table("Stepping and moving the map", MOVING_HEADER, moving, [_MOVING_NOTE])
    )
    return section


_MOVING_NOTE = (
    "step: the next view, leap: a twentieth of all further, from the key to the end of the page's "
    f"work on that frame, {STEPS} keys {PAUSE_MS} ms apart; screen: median until it is on the "
    "screen, by the browser's own account, to 8 ms; the rest: from frame to frame (16.7 where "
    "nothing is late) while the arrow key is held down, the map is dragged, the wheel is turned, "
    "and the course is dragged over; tasks: of the page's one thread"
)


def _cores() -> str:
    count = len(os.sched_getaffinity(0))
    return "one core" if count == 1 else f"{count} cores"


@contextmanager
def _served(run: LongRun, map_path: Path) -> Iterator[tuple[str, float]]:
    """Address of a server in a process of its own, and its start time."""
    command = [sys.executable, "-m", "orthonav", "view", str(run.fixes), "--map", str(map_path)]
    command += ["--truth", str(run.truth), "--no-browser"]
    begun = time.perf_counter()
    popen = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert popen.stdout is not None
        address = popen.stdout.readline().split()[0]
        yield address, time.perf_counter() - begun
    finally:
        popen.terminate()
        popen.communicate(timeout=60)


def _opened(browser: Browser, address: str) -> tuple[Page, float]:
    """The page, drawn, and after how many seconds it was."""
    width, height = SCREEN
    page = browser.new_page(viewport={"width": width, "height": height})
    page.add_init_script(WATCH)
    page.goto(address)
    until = time.monotonic() + MOST_WAIT_S
    while not (opened_ms := _seen(page)["opened"]):
        if time.monotonic() > until:
            raise TimeoutError("the page did not draw the run")
        page.wait_for_timeout(50)
    return page, opened_ms / 1e3


def _seen(page: Page) -> dict[str, Any]:
    """What was seen since the last time."""
    seen: dict[str, Any] = page.evaluate(
        "(() => { const seen = { ...window.orthonavSeen }; Object.assign(window.orthonavSeen,"
        " { frames: [], tasks: [], steps: [], shown: [] }); return seen; })()"
    )
    return seen


def _opening(
    section: Section, browser: Browser, address: str, count: int, served_s: float
) -> list[str]:
    data = f"{count} views over a generated {SIDE_M} m square"
    opened_s, about = [], {}
    for _ in range(OPENINGS):
        page, seconds = _opened(browser, address)
        opened_s.append(seconds)
        about = page.evaluate(
            "({ json: performance.getEntriesByType('resource')"
            ".find((each) => each.name.includes('api/news')).decodedBodySize,"
            " heap: performance.memory.usedJSHeapSize,"
            " elements: document.querySelectorAll('*').length })"
        )
        page.close()
    section.add(f"server up, {count} views", "s", [served_s], data=data, seed=SEED)
    opened = section.add(f"page opened, {count} views", "s", opened_s, data=data, seed=SEED)
    section.add(f"elements, {count} views", "1", [about["elements"]], data=data, seed=SEED)
    cells = [number(v) for v in (served_s, opened.median, opened.p10, opened.p90)]
    cells += [number(about[name] / 1e6) for name in ("json", "heap")]
    return [f"{count:,}", *cells, str(about["elements"])]


def _moving(section: Section, browser: Browser, address: str, count: int) -> list[list[str]]:
    page, _ = _opened(browser, address)
    page.wait_for_timeout(1000)
    rows = []
    for name, act in ACTIONS.items():
        _seen(page)
        act(page)
        seen = _seen(page)
        samples = seen["steps" if name in ("step", "leap") else "frames"]
        data = f"{count} views over a generated {SIDE_M} m square"
        found = section.add(f"{name}, {count} views", "ms", samples, data=data, seed=SEED)
        cells = [number(v) for v in (found.median, found.p10, found.p90, max(samples))]
        longest = number(max(seen["tasks"])) if seen["tasks"] else "-"
        shown = "-"
        if name in ("step", "leap"):
            to_screen = section.add(
                f"{name} to the screen, {count} views", "ms", seen["shown"], data=data, seed=SEED
            )
            shown = number(to_screen.median)
        rows.append([f"{count:,}", name, *cells, shown, str(len(seen["tasks"])), longest])
        page.wait_for_timeout(500)
    page.close()
    return rows


def _step(page: Page) -> None:
    for _ in range(STEPS):
        page.keyboard.press("ArrowRight")
        page.wait_for_timeout(PAUSE_MS)


def _leap(page: Page) -> None:
    for k in range(STEPS):
        page.keyboard.press("PageUp" if k // 10 % 2 else "PageDown")
        page.wait_for_timeout(PAUSE_MS)


def _hold(page: Page) -> None:
    for _ in range(2 * STEPS):
        page.keyboard.down("ArrowRight")
        page.wait_for_timeout(30)
    page.keyboard.up("ArrowRight")


def _drag(page: Page) -> None:
    _swing(page, "#map", 0.5, 200)


def _scrub(page: Page) -> None:
    _swing(page, "#chart", 0.5, 350)


def _swing(page: Page, part: str, height: float, reach_px: int) -> None:
    """Press the button over a part, move back and forth, and release it."""
    box = page.locator(part).bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] * height
    page.mouse.move(x, y)
    page.mouse.down()
    for k in range(MOVES):
        page.mouse.move(x + reach_px * np.sin(2 * np.pi * k / 45), y + 3 * np.sin(k / 7))
        page.wait_for_timeout(16)
    page.mouse.up()


def _zoom(page: Page) -> None:
    box = page.locator("#map").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    for k in range(WHEELS):
        page.mouse.wheel(0, -120 if k < WHEELS / 2 else 120)
        page.wait_for_timeout(250)


ACTIONS = {
    "step": _step,
    "leap": _leap,
    "key held": _hold,
    "map dragged": _drag,
    "map zoomed": _zoom,
    "course": _scrub,
}
