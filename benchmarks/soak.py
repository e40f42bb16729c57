"""`python -m benchmarks.soak [--minutes 60] [--pace 3]`: an hour of flight, watching the memory.

`orthonav fly` on one core beside a fake autopilot, on a looped flight over a generated area,
at increased speed. Writes resident memory each second (CSV), its picture (PNG) and a table.
"""

import argparse
import csv
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import linregress

from benchmarks.inputs import FLIGHT_SEED, PAST, PRESENT, Workplace
from benchmarks.looped_flight import SMALL_CAMERA, LoopedFlight, played, rendered
from benchmarks.pair import Arrivals, Cores, FakeAutopilot, Fly, Lines, Sample, free_port, on_core
from benchmarks.record import Section, Table, number, provenance, save
from orthonav.core.mapfile import open_map

SIDE_M, RATE_HZ, LEAD_S = 2000, 5, 6.0
LOG_MB = 40
WARM_UP, BLOCKS = 0.2, 10
"""Share of the flight that caches may take to fill, and into how many parts the rest is cut."""
FAR_M = 35.0
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Soaked:
    """Results of one soak flight.

    - `views`: number of views flown.
    - `pace`: factor on real time.
    - `exit_code`: exit code of `orthonav fly`.
    - `hours`: flight time of each sample, h.
    - `samples`: samples of the process.
    - `arrivals`: positions received by the fake autopilot.
    - `lines`: log lines of the program.
    - `log_bytes`: sizes of the log files.
    """

    views: int
    pace: float
    exit_code: int
    hours: Array
    samples: list[Sample]
    arrivals: Arrivals
    lines: Lines
    log_bytes: list[int]

    @property
    def rss_mb(self) -> Array:
        """Resident memory at `hours` of flight."""
        return np.array([each.rss_mb for each in self.samples])


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, print and write; returns the exit code, that of the program flown."""
    options = _parser().parse_args(arguments)
    cv2.setNumThreads(1)
    start, started = time.perf_counter(), provenance("soak")
    with tempfile.TemporaryDirectory(prefix="orthonav-soak-") as folder:
        place = Workplace(Path(folder), options.out / "data", quick=False)
        soaked = soak(place, options.minutes, options.pace)
    section = Section("An hour of flight" if options.minutes == 60 else "Long flight")
    section.tables.append(table(section, soaked))
    print(section.markdown())
    wall_s = time.perf_counter() - start
    paths = save(options.out, [section], started, wall_s=wall_s, latest=False)
    paths += [
        _csv(paths[0].with_suffix(".csv"), soaked),
        _plot(paths[0].with_suffix(".png"), soaked),
    ]
    print(f"written to {', '.join(map(str, paths))}", file=sys.stderr)
    return soaked.exit_code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.soak", description=str(__doc__).splitlines()[0]
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="of flight (default 60)")
    parser.add_argument("--pace", type=float, default=3.0, help="times faster (default 3)")
    parser.add_argument("--out", type=Path, default=Path("bench_results"))
    return parser


def soak(place: Workplace, minutes: float, pace: float) -> Soaked:
    """Fly so many minutes, `pace` times as fast."""
    past, present = place.area(SIDE_M, 1.0, [PAST, PRESENT])
    map_path, cores, port = place.map(past), Cores.chosen(), free_port()
    frame = open_map(map_path).manifest.sheets[0].frame
    lap = rendered(place, present, frame, LoopedFlight(SMALL_CAMERA, RATE_HZ))
    views, scratch = round(minutes * 60 * RATE_HZ), place.scratch
    folder = played(lap, scratch / "flight", views, lead_s=LEAD_S * pace)
    lines = scratch / "lines.jsonl"
    command = [str(map_path), str(folder), "--file-clock", "autopilot"]
    command += ["--pace", str(pace), "--autopilot", f"udpin:{port}", "--jsonl", str(lines)]
    command += ["--log", str(scratch / "log.mcap"), "--log-views", "thumbnails"]
    command += ["--log-max-mb", str(LOG_MB), "--state", str(scratch / "state.json")]
    with on_core(cores.other), FakeAutopilot(folder, port, cores.other, pace) as fake_autopilot:
        with Fly(command, cores.flying, scratch / "errors.txt") as fly:
            fly.watch(fake_autopilot.mono_ns(LEAD_S * pace + minutes * 60) + 120 * 10**9)
        print((scratch / "errors.txt").read_text(), file=sys.stderr, end="")
    samples = [each for each in fly.samples if each.at_ns > fake_autopilot.mono_ns(LEAD_S * pace)]
    hours = (
        np.array([(s.at_ns - fake_autopilot.mono_ns(LEAD_S * pace)) for s in samples])
        / 3.6e12
        * pace
    )
    return Soaked(
        views=views,
        pace=pace,
        exit_code=fly.process.returncode or 0,
        hours=hours,
        samples=samples,
        arrivals=Arrivals.of(fake_autopilot),
        lines=Lines.read(lines),
        log_bytes=[path.stat().st_size for path in sorted(scratch.glob("log_*.mcap"))],
    )


def slope(hours: Array, rss_mb: Array) -> tuple[float, float]:
    """Growth in MB per hour of flight after the warm-up, and its standard error.

    Memory comes in steps, so single seconds are no independent readings: the line is laid through
    the means of `BLOCKS` parts.
    """
    warm = hours >= WARM_UP * hours[-1]
    parts = [
        (float(x.mean()), float(y.mean()))
        for x, y in zip(
            np.array_split(hours[warm], BLOCKS), np.array_split(rss_mb[warm], BLOCKS), strict=True
        )
    ]
    line: Any = linregress(*np.array(parts).T)
    return float(line.slope), float(line.stderr)


def table(section: Section, soaked: Soaked) -> Table:
    """What came of it."""
    rss_mb, samples, errors_m = soaked.rss_mb, soaked.samples, soaked.arrivals.error_m
    grown, spread = slope(soaked.hours, rss_mb)
    handled, sent = len(soaked.lines.ages_ms), len(errors_m)
    counts = soaked.lines.health.get("counts", {})
    wall_s = (samples[-1].at_ns - samples[0].at_ns) / 1e9
    busy = (samples[-1].cpu_s - samples[0].cpu_s) / wall_s
    warm = rss_mb[soaked.hours >= WARM_UP * soaked.hours[-1]]
    section.add("resident memory", "MB", rss_mb, data="lap", seed=FLIGHT_SEED)
    section.add("error", "m", errors_m, data="lap", seed=FLIGHT_SEED)
    section.facts = {
        "soak_mb_per_hour": grown,
        "soak_mb_per_hour_std": spread,
        "soak_peak_mb": samples[-1].peak_mb,
        "soak_dropped": soaked.views - handled,
        "soak_far": int((errors_m > FAR_M).sum()),
    }
    degraded_s = (
        ", ".join(f"{name} {count}" for name, count in soaked.lines.reasons.most_common()) or "none"
    )
    rows = [
        ["growth after warm-up, MB per hour of flight", f"{grown:+.2f} +- {spread:.2f}"],
        ["resident memory after warm-up, least and most, MB", f"{_range(warm)}"],
        ["largest of all (VmHWM), MB", number(samples[-1].peak_mb)],
        ["flown, minutes (on the clock)", f"{60 * soaked.hours[-1]:.1f} ({wall_s / 60:.1f})"],
        ["views, dropped of them", f"{soaked.views:,}, {soaked.views - handled:,}"],
        ["messages that arrived", f"{sent:,}"],
        ["error p50, p95, max, m", ", ".join(_percentiles(errors_m, 50, 95, 100))],
        [f"farther off than {FAR_M:.0f} m", str(int((errors_m > FAR_M).sum()))],
        ["exposure to message p50, p99, ms", _latency(soaked)],
        ["share of the core", f"{busy:.0%}"],
        ["log files at the end, MB in all", f"{len(soaked.log_bytes)}, {_mb(soaked.log_bytes)}"],
        ["times that the log lost something", str(counts.get("log_failed", 0))],
        ["views that failed inside", str(counts.get("internal_error", 0))],
        ["seconds with a reason of health", degraded_s],
        ["exit code", str(soaked.exit_code)],
    ]
    camera = SMALL_CAMERA
    notes = (
        f"`orthonav fly` on one core, {camera.width_px} x {camera.height_px} px views at {RATE_HZ} "
        f"Hz of flight, {soaked.pace:g} times as fast, round and round over 4 km2 of generated "
        "ground of another date; log with thumbnails, at most "
        f"{LOG_MB} MB, state and lines written; resident memory read each second",
        f"warm-up: the first {WARM_UP:.0%}; growth: line through the means of {BLOCKS} parts, with "
        "its standard error",
    )
    return Table(section.title, ("what", "figure"), rows, notes)


def _latency(soaked: Soaked) -> str:
    return ", ".join(_percentiles(soaked.arrivals.latency_ms, 50, 99))


def _percentiles(values: Array, *percents: float) -> list[str]:
    return [number(float(np.percentile(values, p))) if values.size else "-" for p in percents]


def _range(values: Array) -> str:
    return f"{values.min():.1f} to {values.max():.1f}"


def _mb(sizes: Sequence[int]) -> str:
    return number(sum(sizes) / 1e6)


def _csv(path: Path, soaked: Soaked) -> Path:
    with path.open("w", encoding="ascii", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(("flight_s", "rss_mb", "peak_mb", "cpu_s"))
        for hours, one in zip(soaked.hours, soaked.samples, strict=True):
            row = (3600 * hours, one.rss_mb, one.peak_mb, one.cpu_s)
            writer.writerow([f"{value:.2f}" for value in row])
    return path


def _plot(path: Path, soaked: Soaked) -> Path:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    grown, spread = slope(soaked.hours, soaked.rss_mb)
    figure, axes = pyplot.subplots(figsize=(8, 3.5), layout="constrained")
    axes.plot(60 * soaked.hours, soaked.rss_mb, linewidth=0.8)
    axes.axvline(60 * WARM_UP * soaked.hours[-1], color="grey", linewidth=0.8, linestyle=":")
    axes.set(xlabel="minutes of flight", ylabel="resident memory, MB", ylim=(0, None))
    axes.set_title(f"{grown:+.2f} +- {spread:.2f} MB per hour after warm-up", fontsize=10)
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
    return path


if __name__ == "__main__":
    sys.exit(main())
