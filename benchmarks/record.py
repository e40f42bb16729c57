"""How a question is run, and what it leaves: tables for people, rows for programs, the machine."""

import argparse
import contextlib
import csv
import datetime
import json
import math
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

PACKAGES = (
    *("orthonav", "numpy", "scipy", "opencv-python-headless", "safetensors", "pymavlink", "mcap"),
    *("rasterio", "torch", "onnx", "onnxruntime", "faiss-cpu", "scikit-image", "transformers"),
)
Adds = Callable[[argparse.ArgumentParser], None]


@dataclass(frozen=True)
class Table:
    """Rows of text under a header, the first column left-aligned, with notes below."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()

    def markdown(self, level: int = 3) -> str:
        """The table in Markdown, its columns aligned for the terminal."""
        lines = [self.header, *self.rows]
        widths = [max(2, *(len(line[col]) for line in lines)) for col in range(len(self.header))]
        rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
        text = [f"{'#' * level} {self.title}", ""]
        for line in (self.header, rule, *self.rows):
            first, *rest = line
            cells = [first.ljust(widths[0])]
            cells += [cell.rjust(width) for cell, width in zip(rest, widths[1:], strict=True)]
            text.append(f"| {' | '.join(cells)} |")
        notes = [f"- {note}" for note in self.notes]
        return "\n".join([*text, "", *notes, ""] if notes else [*text, ""])


@dataclass
class Section:
    """What a question found. `failed`: whether the exit code says so."""

    title: str
    tables: list[Table] = field(default_factory=list)
    failed: bool = False

    def markdown(self) -> str:
        return "\n".join([f"## {self.title}", "", *(table.markdown() for table in self.tables)])


def number(value: float) -> str:
    """Three digits that count, never an exponent."""
    if not math.isfinite(value):
        return "-"
    digits = 2 - math.floor(math.log10(abs(value))) if value else 0
    return f"{value:,.{min(6, max(0, digits))}f}"


def percent(share: float, digits: int = 0) -> str:
    return "-" if math.isnan(share) else f"{share:.{digits}%}"


def quantiles(values: Any, *percents: float) -> list[str]:
    """Percentiles of values (N,) as cells of a table."""
    known = np.asarray(values, np.float64)
    return [number(float(np.percentile(known, p))) if known.size else "-" for p in percents]


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def run(measure: Callable[[argparse.Namespace], Section], add: Adds | None = None) -> int:
    """Run the question of the module that was started, with the options of all and those that `add`
    adds, print its tables and write them; returns the exit code."""
    module = sys.modules["__main__"]
    name = str(module.__spec__ and module.__spec__.name.split(".")[1])
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}", description=str(module.__doc__).splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="smaller areas, fewer views")
    parser.add_argument(
        "--work", type=Path, metavar="DIR", help="maps, flights and rows are kept here"
    )
    parser.add_argument("--out", type=Path, default=Path("bench_results"), metavar="DIR")
    if add is not None:
        add(parser)
    options = parser.parse_args()
    options.work = options.work or options.out / "work" / name
    options.work.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    start, started = time.perf_counter(), provenance(name)
    section = measure(options)
    print(section.markdown(), flush=True)
    _save(options.out, section, started, time.perf_counter() - start)
    return int(section.failed)


def memory_mb() -> float:
    """Largest resident memory of this process in MB.

    Linux's own count: `ru_maxrss` of a started process also remembers its parent's memory.
    """
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024 / 1e6


def side_by_side(
    function: Callable[[Any], Any], tasks: Sequence[Any], workers: int
) -> Iterator[Any]:
    """`function(task)` of each task, in order, by so many processes."""
    if workers == 1:
        yield from map(function, tasks)
        return
    # Not forked: threads of this process would be lost in a child.
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        yield from pool.map(function, tasks)


def rows_path(work: Path, name: str) -> Path:
    """The file of `resumed`: rows of another commit are not taken for those of this one."""
    return work / f"{name}-{git('rev-parse', '--short=10', 'HEAD') or 'unknown'}.jsonl"


def resumed(
    path: Path, function: Callable[[Any], Any], tasks: dict[str, Any], workers: int = 1
) -> Iterator[Any]:
    """`function(task)` by key, in order, as JSON; each is a line of `path` as soon as it is there.

    Those that have a line are not made again, so an interrupted run goes on.
    """
    found: dict[str, Any] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        with contextlib.suppress(ValueError):  # the line that was being written
            found.update([json.loads(line)])
    missing = [key for key in tasks if key not in found]
    with path.open("a", encoding="utf-8") as stream:
        stream.write("\n" if path.stat().st_size else "")
        made = side_by_side(function, [tasks[key] for key in missing], workers)
        for key in tasks:
            if key not in found:
                found[key] = next(made)
                stream.write(json.dumps([key, found[key]]) + "\n")
                stream.flush()
            yield found[key]


def read_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a table with a header, as text."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def _save(out: Path, section: Section, started: dict[str, Any], wall_s: float) -> None:
    """Write JSON and Markdown named by date and commit. `started`: the `provenance` of before."""
    load = " ".join(f"{value:.2f}" for value in os.getloadavg())
    about = {**started, "wall_s": round(wall_s), "load_1_5_15_min": load}
    stem = f"{about['date'][:19].replace(':', '')}-{about['commit'][:10]}-{about['run']}"
    head = "\n".join(f"- {key}: {value}" for key, value in about.items())
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{stem}.md").write_text(f"{head}\n\n{section.markdown()}", encoding="utf-8")
    plain = json.dumps({**about, "section": asdict(section)}, indent=1)
    (out / f"{stem}.json").write_text(plain + "\n", encoding="utf-8")
    say(f"{wall_s:5.0f} s  written to {out / stem}.md and .json")


def provenance(run: str) -> dict[str, Any]:
    """Commit, date, machine and versions; `run` names the run."""
    with Path("/proc/meminfo").open() as stream:
        memory_gb = int(stream.readline().split()[1]) / 2**20
    return {
        "commit": git("rev-parse", "HEAD") or "unknown",
        "dirty": bool(git("status", "--porcelain")),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "run": run,
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "memory_gb": round(memory_gb, 1),
        "system": platform.platform(),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"


def git(*arguments: str) -> str:
    """What git prints, without its end of line; empty where it fails."""
    try:
        found = subprocess.run(("git", *arguments), capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return found.stdout.strip()


def _cpu() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or "unknown"
