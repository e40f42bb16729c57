"""This checkout against another one: accuracy, confidence, time and memory of the same views.

`python -m benchmarks.against OTHER [--views N] [--rounds N] [--part growth] [--only TEXT ..]`.
OTHER is a checkout of any commit that has `orthonav localize`. Both localize the same flights on
the same maps, which OTHER builds, each in a process of its own, in turn; compared are the fixes
that they write. Imagery that is absent is left out. `--part growth`: rows with other errors and
sizes of views; with this checkout as OTHER, how time and memory grow with them.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.record import Section, Table, git, number, percent, run, say
from benchmarks.scenes import (
    PAST,
    PRESENT,
    SCENES,
    WIDE,
    agl_of,
    area,
    far_m,
    flight,
    gsd_of,
    is_there,
    ortho,
)
from orthonav.core.flight import read_truth
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import CONFIDENT

ROOT = Path(__file__).resolve().parents[1]
HERE, THERE = "here", "other"
SEED = 7
LAUNCHER = """
import json, resource, subprocess, sys
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e6]))
sys.exit(code)
"""
"""A process remembers the memory of the one that starts it, so that is a small one."""
HEADER = (
    *("map", "views", "n", "CPU ms", "other", "times faster", "ms", "other", "p99 ms", "other"),
    *("correct", "other", "accepted", "other", "false", "other", "peak MB", "other"),
)


@dataclass(frozen=True)
class Case:
    """Views over a map: `map` and `views` are names of orthophotos, or sides of generated squares
    in metres; `prior_px`: standard deviation of a prior, pixels of the map; `yaw_std_deg` and
    `agl_std`: of heading and height (fraction), as reported."""

    map: str
    views: str
    width_px: int = 256
    heading_known: bool = True
    prior_px: float | None = None
    yaw_std_deg: float = 10.0
    agl_std: float = 0.1

    @property
    def name(self) -> str:
        heading = f"to {self.yaw_std_deg:g} deg" if self.heading_known else "unknown"
        height = "" if self.agl_std == 0.1 else f", height to {self.agl_std:.0%}"
        prior = "" if self.prior_px is None else f", prior to {self.prior_px:g} px"
        return f"{self.map}: {self.width_px} px, heading {heading}{height}{prior}"


def growth() -> Iterator[Case]:
    """Other errors and sizes over 16 km2, and a prior on 100 km2."""
    yield Case("4000", "2000", yaw_std_deg=40.0)
    for std in (0.02, 0.3):
        yield Case("4000", "2000", agl_std=std)
    for width_px in (96, 128, 512):
        yield Case("4000", "2000", width_px)
    yield Case("10000", "2000", prior_px=50.0)


def cases() -> Iterator[Case]:
    yield Case("2000", "2000")
    yield Case("2000", "2000", heading_known=False)
    yield Case("2000", "2000", 128)
    yield Case("2000", "2000", 128, prior_px=40.0)
    naip = SCENES["naip"].pair("20090818", "20180716")
    yield Case(naip.map, naip.views)
    yield Case(naip.map, naip.views, heading_known=False)
    yield Case(naip.map, naip.views, 128)
    mosaic = SCENES["szada_mosaic"].pair("szada_mosaic_a", "szada_mosaic_b")
    schiphol = SCENES["schiphol"].pair("2004_05", "2018_04")
    for pair in (mosaic, schiphol):
        yield Case(pair.map, pair.views)
        yield Case(pair.map, pair.views, 128)
    for side_m in ("4000", "10000"):
        yield Case(side_m, "2000")
        yield Case(side_m, "2000", heading_known=False)


PARTS = {"usual": cases, "growth": growth}


@dataclass(frozen=True, eq=False)
class Tree:
    """A checkout, and what it made of the views of a case: rows of error (m) and confidence, clock
    times (ms), processor times of a view by round (ms), largest memory."""

    root: Path
    rows: list[tuple[float, float]] = field(default_factory=list)
    clock_ms: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    peak_mb: float = 0.0

    def orthonav(self, *arguments: str) -> tuple[float, float]:
        """Run a command of this checkout; processor seconds and largest memory (MB) it took."""
        environment = {**os.environ, "PYTHONPATH": str(self.root / "src")}
        command = [sys.executable, "-c", LAUNCHER, sys.executable, "-m", "orthonav", *arguments]
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=False)
        if done.returncode:
            raise RuntimeError(f"{self.root}: orthonav {' '.join(arguments)} failed")
        cpu_s, peak_mb = json.loads(done.stdout)
        return cpu_s, peak_mb

    def localized(self, case: Case, map_path: Path, folder: Path, out: Path) -> "Tree":
        """With another round over a flight."""
        heading = "known" if case.heading_known else "unknown"
        prior = "none" if case.prior_px is None else "telemetry"
        more = ["--heading", heading, "--prior", prior, "--out", str(out), "--quiet"]
        start_s, _ = self.orthonav("localize", str(map_path), str(_blank(folder)), *more)
        whole_s, peak_mb = self.orthonav("localize", str(map_path), str(folder), *more)
        fixes = [json.loads(line) for line in out.read_text(encoding="ascii").splitlines()]
        truth = read_truth(folder / "truth.csv")
        rows = [_row_of(each, truth[each["frame"]]) for each in fixes]
        cpu_ms = 1e3 * (whole_s - start_s) / len(fixes)
        clock_ms = [each["latency_ms"] for each in fixes[1:]]
        return replace(
            self,
            rows=rows,
            clock_ms=self.clock_ms + clock_ms,
            cpu_ms=[*self.cpu_ms, cpu_ms],
            peak_mb=max(self.peak_mb, peak_mb),
        )


def _blank(folder: Path) -> Path:
    """The same flight with one blank view: what starting and opening take."""
    out = folder.with_name(f"{folder.name}-blank")
    if not out.is_dir():
        (out / "frames").mkdir(parents=True)
        header, first = (folder / "telemetry.csv").read_text(encoding="utf-8").splitlines()[:2]
        (out / "telemetry.csv").write_text(f"{header}\n{first}\n", encoding="utf-8")
        name = first.split(",")[0]
        grey = cv2.imread(str(folder / "frames" / name))
        cv2.imwrite(str(out / "frames" / name), np.full_like(grey, 128))
        shutil.copyfile(folder / "flight.json", out / "flight.json")
    return out


def _row_of(fix: dict[str, Any], truth: tuple[float, float]) -> tuple[float, float]:
    if fix["status"] != "fix":
        return float("inf"), 0.0
    off = LocalFrame(*truth).en_from_latlon(fix["lat_deg"], fix["lon_deg"])
    return float(np.hypot(*off)), float(fix["confidence"])


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("other", type=Path, help="checkout of another commit")
    parser.add_argument("--views", type=int, default=100, help="views per row")
    parser.add_argument("--rounds", type=int, default=2, help="times that both localize them")
    parser.add_argument("--part", choices=PARTS, default="usual")
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="rows that contain one of these")


def measure(options: argparse.Namespace) -> Section:
    rows = []
    for case in PARTS[options.part]():
        if options.only and not any(text in case.name for text in options.only):
            continue
        if case.map.endswith(".tif") and not is_there(case.map, case.views):
            continue
        rows.append(_row(case, options))
        say(" | ".join(rows[-1]))
    commit = git("-C", str(options.other), "describe", "--always", "--dirty")
    notes = (
        f"other: commit {commit}; CPU ms: processor time of a view, less that of a blank one, "
        f"least of {options.rounds} rounds in turn; ms, p99: on the clock, by the "
        "fixes; peak: of the process; height known to 10 % unless stated",
        f"correct: within 35 m or 10 px; accepted: of these, confidence of {CONFIDENT:g} or more",
    )
    title = "Against another commit"
    return Section(title, [Table(title, HEADER, rows, notes)])


def _row(case: Case, options: argparse.Namespace) -> list[str]:
    trees = {HERE: Tree(ROOT), THERE: Tree(options.other.resolve())}
    map_path, folder, gsd_m = _inputs(case, trees[THERE], options)
    for _ in range(options.rounds):
        for name, tree in trees.items():
            trees[name] = tree.localized(case, map_path, folder, options.work / f"{name}.jsonl")

    def both(cell: Any) -> list[str]:
        return [cell(tree) for tree in trees.values()]

    def right(tree: Tree) -> Any:
        return np.array([error_m <= far_m(gsd_m) for error_m, _ in tree.rows])

    def accepted(tree: Tree) -> Any:
        return np.array([confidence >= CONFIDENT for _, confidence in tree.rows])

    def share(tree: Tree) -> float:
        return float(accepted(tree)[right(tree)].mean()) if right(tree).any() else float("nan")

    faster = min(trees[THERE].cpu_ms) / min(trees[HERE].cpu_ms)
    where, _, what = case.name.partition(": ")
    return [
        *(where, what, str(len(trees[HERE].rows))),
        *(*both(lambda tree: number(min(tree.cpu_ms))), f"{faster:.2f}"),
        *both(lambda tree: number(float(np.median(tree.clock_ms)))),
        *both(lambda tree: number(float(np.percentile(tree.clock_ms, 99)))),
        *both(lambda tree: percent(float(right(tree).mean()))),
        *both(lambda tree: percent(share(tree))),
        *both(lambda tree: str(int((accepted(tree) & ~right(tree)).sum()))),
        *both(lambda tree: number(tree.peak_mb)),
    ]


def _inputs(case: Case, other: Tree, options: argparse.Namespace) -> tuple[Path, Path, float]:
    """Map, flight and ground resolution of a case; made once."""
    work = options.work
    past = _ortho(case.map, PAST, work)
    flown = _ortho(case.views, PRESENT, work)
    gsd_m = gsd_of(past)
    prior_m = None if case.prior_px is None else case.prior_px * gsd_m
    stds = {"yaw_std_deg": case.yaw_std_deg, "agl_std": case.agl_std}
    errors, agl_m = replace(WIDE, prior_std_m=prior_m, **stds), agl_of(case.width_px, gsd_m)
    views = 6 if options.quick else options.views
    folder = flight(flown, work, views=views, errors=errors, seed=SEED, agl_m=agl_m)
    built = work / f"{past.parent.name}-{past.stem}.onav"
    if not built.is_file():
        other.orthonav("build", "--ortho", str(past), "--out", str(built))
    return built, folder, gsd_m


def _ortho(name: str, date: str, work: Path) -> Path:
    return area(work, date, side_m=int(name)) if name.isdigit() else ortho(name, work)


if __name__ == "__main__":
    sys.exit(run(measure, add))
