"""Whole processes: how long the command line takes to answer, how much memory a flight takes."""

import json
import subprocess
import sys
from pathlib import Path

from benchmarks.inputs import FLIGHT_SEED, PAST, PRESENT, USUAL_ERRORS, Workplace
from benchmarks.machine import seconds
from benchmarks.record import Section, Table, number

RUNS = 15


def measure(place: Workplace) -> Section:
    """Time start-up, and the memory of `orthonav localize`."""
    section = Section("Whole processes")
    program = Path(sys.executable).with_name("orthonav")
    script = [str(program)] if program.is_file() else [sys.executable, "-m", "orthonav"]
    rows = []
    for name, command in {
        "`python -c pass` (floor)": [sys.executable, "-c", "pass"],
        "`orthonav --help`": [*script, "--help"],
        "`orthonav localize --help`": [*script, "localize", "--help"],
    }.items():
        times_ms = [1e3 * seconds(_quietly, command) for _ in range(RUNS)]
        timing = section.add(name, "ms", times_ms, data="none")
        spread = f"{number(timing.p10)}..{number(timing.p90)}"
        rows.append([name, "ms", number(timing.median), spread, str(timing.n)])
    ortho, present = place.area(2000, 1.0, [PAST])[0], place.area(2000, 1.0, [PRESENT])[0]
    flight = place.fly(present, place.views, USUAL_ERRORS)
    localize = ["localize", str(place.map(ortho)), str(flight.folder), "--out"]
    localize += [str(place.scratch / "fixes.jsonl"), "--quiet"]
    for name, arguments in {
        "imports of NumPy and OpenCV only (floor)": [],
        f"`orthonav localize`, {place.views} views": localize,
    }.items():
        peaks = [_peak_mb(arguments) for _ in range(place.repeats)]
        peak = section.add(name, "MB", peaks, data="generated 2 x 2 km", seed=FLIGHT_SEED)
        spread = f"{number(peak.p10)}..{number(peak.p90)}"
        rows.append([name, "peak MB", number(peak.median), spread, str(peak.n)])
    header = ("process", "unit", "median", "p10..p90", "n")
    section.tables = [Table("Whole processes", header, rows)]
    return section


def _quietly(command: list[str]) -> None:
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)


def _peak_mb(arguments: list[str]) -> float:
    command = [sys.executable, "-m", "benchmarks.child", "run", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(json.loads(done.stdout.splitlines()[-1]))
