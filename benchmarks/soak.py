"""`python -m benchmarks.soak [--minutes 60] [--pace 4]`: an hour of flight, watching the memory.

`orthonav fly` on one core beside a fake autopilot, on a looped flight over a generated area, at
increased speed.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import linregress

from benchmarks.looped_flight import SMALL_CAMERA, LoopedFlight, played, rendered
from benchmarks.pair import Arrivals, Cores, FakeAutopilot, Fly, Lines, free_port, on_core
from benchmarks.record import Section, Table, number, quantiles, run
from benchmarks.scenes import FAR_M, PAST, PRESENT, area, map_of
from orthonav.core.mapfile import open_map

NAME = "soak"
RATE_HZ, LEAD_S, LOG_MB = 5, 6.0, 40
WARM_UP, BLOCKS = 0.2, 10
"""Fraction of the flight that caches may take to fill, and into how many parts the rest is cut."""
Array = NDArray[np.float64]


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--minutes", type=float, default=60.0, help="of flight")
    parser.add_argument("--pace", type=float, default=4.0, help="times faster")


def measure(options: argparse.Namespace) -> Section:
    """Fly so many minutes, `pace` times as fast."""
    minutes, pace, work = options.minutes, options.pace, options.work
    past, present = (area(work, date) for date in (PAST, PRESENT))
    map_path, cores, port = map_of(past, work), Cores.chosen(), free_port()
    frame = open_map(map_path).manifest.sheets[0].frame
    lap = rendered(work, present, frame, LoopedFlight(SMALL_CAMERA, RATE_HZ))
    views, lines = round(minutes * 60 * RATE_HZ), work / "lines.jsonl"
    folder = played(lap, work / "flight", views, lead_s=LEAD_S * pace)
    command = [str(map_path), str(folder)]
    command += ["--pace", str(pace), "--autopilot", f"udpin:{port}", "--jsonl", str(lines)]
    command += ["--log", str(work / "log.mcap"), "--log-views", "thumbnails"]
    command += ["--log-max-mb", str(LOG_MB), "--state", str(work / "state.json")]
    for old in (*work.glob("log*.mcap"), work / "state.json", lines):
        old.unlink(missing_ok=True)
    with (
        on_core(cores.other),
        FakeAutopilot(folder, port, cores.other, pace) as fake_autopilot,
        Fly(command, cores.flying, work / "errors.txt") as fly,
    ):
        fly.watch(fake_autopilot.mono_ns(LEAD_S * pace + minutes * 60) + 120 * 10**9)
    begin_ns = fake_autopilot.mono_ns(LEAD_S * pace)
    samples = [each for each in fly.samples if each.at_ns > begin_ns]
    hours = np.array([each.at_ns - begin_ns for each in samples]) / 3.6e12 * pace
    table = _table(
        views,
        hours,
        np.array([each.rss_mb for each in samples]),
        Arrivals.of(fake_autopilot),
        Lines.read(lines),
        sorted(work.glob("log_*.mcap")),
    )
    cpu_s, wall_s = (
        samples[-1].cpu_s - samples[0].cpu_s,
        (samples[-1].at_ns - samples[0].at_ns) / 1e9,
    )
    rows = [
        *table,
        ["largest of all (VmHWM), MB", number(samples[-1].peak_mb)],
        ["fraction of the core", f"{cpu_s / wall_s:.0%}"],
        ["exit code", str(fly.process.returncode)],
    ]
    notes = (
        f"`orthonav fly` on one core, {SMALL_CAMERA.width_px} x {SMALL_CAMERA.height_px} px at "
        f"{RATE_HZ} Hz of flight, {pace:g} times as fast, 4 km2 of generated ground of another "
        f"date; log with thumbnails, at most {LOG_MB} MB, state and lines written",
        f"warm-up: the first {WARM_UP:.0%}; growth: line through the means of {BLOCKS} parts, with "
        "its standard error",
    )
    shown = Table("Long flight", ("what", "figure"), rows, notes)
    return Section("Long flight", [shown], failed=bool(fly.process.returncode))


def slope(hours: Array, rss_mb: Array) -> tuple[float, float]:
    """Growth in MB per hour of flight after the warm-up, and its standard error.

    Memory comes in steps, so single seconds are no independent readings: the line is laid through
    the means of `BLOCKS` parts.
    """
    warm = hours >= WARM_UP * hours[-1]
    parts = [np.array_split(each[warm], BLOCKS) for each in (hours, rss_mb)]
    means = [[float(part.mean()) for part in each] for each in parts]
    line: Any = linregress(*means)
    return float(line.slope), float(line.stderr)


def _table(
    views: int, hours: Array, rss_mb: Array, arrivals: Arrivals, lines: Lines, logs: Sequence[Path]
) -> list[list[str]]:
    grown, spread = slope(hours, rss_mb)
    warm = rss_mb[hours >= WARM_UP * hours[-1]]
    errors_m, counts = arrivals.error_m, lines.health.get("counts", {})
    reasons = ", ".join(f"{name} {count}" for name, count in lines.reasons.most_common())
    log_mb = sum(path.stat().st_size for path in logs) / 1e6
    return [
        ["growth after warm-up, MB per hour of flight", f"{grown:+.2f} +- {spread:.2f}"],
        ["resident memory after warm-up, MB", f"{warm.min():.1f} to {warm.max():.1f}"],
        ["views, dropped of them", f"{views:,}, {views - len(lines.ages_ms):,}"],
        ["messages that arrived", f"{len(errors_m):,}"],
        ["error p50, p95, max, m", ", ".join(quantiles(errors_m, 50, 95, 100))],
        [f"farther off than {FAR_M:.0f} m", str(int((errors_m > FAR_M).sum()))],
        ["exposure to message p50, p99, ms", ", ".join(quantiles(arrivals.latency_ms, 50, 99))],
        ["log files at the end, MB in all", f"{len(logs)}, {number(log_mb)}"],
        ["times that the log lost something", str(counts.get("log_failed", 0))],
        ["views that failed inside", str(counts.get("internal_error", 0))],
        ["seconds with a reason of health", reasons or "none"],
    ]


if __name__ == "__main__":
    sys.exit(run(NAME, __doc__, measure, add))
