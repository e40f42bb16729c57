"""All sections in order, and the files written from them."""

import argparse
import logging
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2

from benchmarks import (
    atlas_build,
    atlas_search,
    building,
    comparison,
    growth,
    growth_hours,
    growth_sheets,
    onboard,
    per_view,
    processes,
    profile,
    search_scale,
    side_by_side,
    tracking,
    view_page,
)
from benchmarks.inputs import Workplace
from benchmarks.record import Section, provenance, save, targets_table

SECTIONS: dict[str, Callable[[Workplace], Section]] = {
    "build": building.measure,
    "view": per_view.measure,
    "search": search_scale.measure,
    "process": processes.measure,
    "compare": comparison.measure,
    "registration": side_by_side.measure,
    "growth": growth.measure,
    "growth-hours": growth_hours.measure,
    "growth-sheets": growth_sheets.measure,
    "cameras": growth.cameras,
    "profile": profile.measure,
    "track": tracking.measure,
    "onboard": onboard.measure,
    "page": view_page.measure,
    "atlas-build": atlas_build.measure,
    "atlas-search": atlas_search.measure,
}


def run_suite(arguments: Sequence[str]) -> int:
    """Run the chosen sections; returns the exit code."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.ERROR, format="%(levelname)s: %(message)s")
    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    start = time.perf_counter()
    started = provenance(_kind(options))
    done: list[Section] = []
    with tempfile.TemporaryDirectory(prefix="orthonav-bench-") as folder:
        place = Workplace(Path(folder), options.out / "data", options.quick)
        for name in options.only or SECTIONS:
            _say(f"{time.perf_counter() - start:5.0f} s  {name} ..")
            section = SECTIONS[name](place)
            print(section.markdown(), flush=True)
            done.append(section)
    done.append(targets_table(done))
    print(done[-1].markdown())
    wall_s = time.perf_counter() - start
    paths = save(options.out, done, started, wall_s=wall_s, latest=started["run"] == "full")
    _say(f"{wall_s:5.0f} s  done; written to {', '.join(map(str, paths))}")
    return 0


def _kind(options: argparse.Namespace) -> str:
    kind = "quick" if options.quick else "full"
    return "-".join([kind, "only", *options.only]) if options.only else kind


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="smaller areas, fewer views")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, help="only these sections")
    parser.add_argument(
        "--out", type=Path, default=Path("bench_results"), help="folder (default bench_results)"
    )
    return parser


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
