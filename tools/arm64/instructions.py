"""How many instructions a view takes on 64-bit ARM and on x86-64, counted by QEMU and Valgrind.

    python tools/arm64/instructions.py FOLDER [--views 9] [--run views track]

FOLDER is that of `run.sh`, which is run first. Views of the stored flight are located in a process
with N views and in one with 2 N. The difference of the two, divided by N, is that of one view:
what starts Python, opens the map and warms caches is in both. One thread. Beside the counts stands
the processor time of the same difference on this machine, without emulation.

The last columns are no measurement: instructions, divided by assumed instructions per cycle and by
the clock of a Raspberry Pi 5. See docs/platforms.md.
"""

import argparse
import json
import os
import re
import resource
import statistics
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

HERE = Path(__file__).resolve().parent
CHECKOUT = HERE.parents[1]
GOLDEN = CHECKOUT / "tests" / "data" / "golden_flight"
RUNS = "views", "track"
CLOCK_HZ = 2.4e9
"""Of the four Cortex-A76 of a Raspberry Pi 5."""
PER_CYCLE = 1.0, 2.0
"""Assumed instructions per cycle: a quarter and half of the four that a Cortex-A76 decodes."""
HEADER = (
    *("processor", "run", "instructions a view, millions", "of those of AVX2"),
    *(f"estimate for a Raspberry Pi 5 at {each:g} a cycle, ms" for each in PER_CYCLE),
)
REPEATS = 5
VALGRIND = "valgrind", "--tool=cachegrind", "--cache-sim=no", "--cachegrind-out-file=/dev/null"
"""It has no AVX-512. QEMU 7.2 with AVX2 ends with a fault in NumPy's `argpartition`."""
NEHALEM = "qemu-x86_64", "-cpu", "Nehalem"
COUNTED = re.compile(r"^(?:instructions:|==\d+== I +refs:) +([\d,]+)$", re.MULTILINE)


@dataclass(frozen=True)
class Processor:
    """A Python on an emulated processor: its name, the command that starts it, its environment."""

    name: str
    command: Sequence[str]
    environment: dict[str, str] = field(default_factory=dict)


Measure = Callable[[Processor, str, int], float]
"""Of a number of views, located by one of `RUNS`."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Prepare, count, print the table; returns the exit code."""
    options = _parser().parse_args(arguments)
    if options.child:
        run, views = options.child
        print(json.dumps(located(run, int(views))))
        return 0
    for run in options.run:
        seconds = [_per_view(_processor_s, _native(), run, options.views) for _ in range(REPEATS)]
        print(f"{run}: {1e3 * statistics.median(seconds):.1f} ms of processor time a view here")
    print(f"| {' | '.join(HEADER)} |\n|---|---|{'--:|' * (len(HEADER) - 2)}", flush=True)
    processors = prepared(options.folder)
    for run in options.run:
        base = None
        for processor in processors:
            count = _per_view(_instructions, processor, run, options.views)
            base = base or count
            print(f"| {' | '.join(row(processor.name, run, count, base))} |", flush=True)
    return 0


def prepared(folder: Path) -> list[Processor]:
    """The emulated processors, that of the other counts first; what they need is made in FOLDER."""
    environment = {**os.environ, "QEMU_CPU": "cortex-a76"}
    command = [str(HERE / "run.sh"), str(folder), "python", "-c", "pass"]
    subprocess.run(command, check=True, env=environment, stdout=sys.stderr)
    plugin = str(folder.resolve() / "count.so")
    source = str(HERE / "count.c")
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", plugin, source], check=True)
    emulated = {"QEMU": "qemu-aarch64", "QEMU_PLUGIN": plugin}
    return [
        Processor("x86-64 with AVX2", [*VALGRIND, sys.executable]),
        Processor("x86-64 with SSE4.2 (Nehalem)", [*NEHALEM, "-plugin", plugin, sys.executable]),
        Processor("64-bit ARM (Cortex-A76)", [str(folder.resolve() / "python")], emulated),
    ]


def located(run: str, views: int) -> int:
    """Locate the first views of the stored flight, one by one or as a track; how many fixes."""
    import cv2

    from orthonav.core.flight import open_flight
    from orthonav.core.localize import Localizer
    from orthonav.core.mapfile import open_map
    from orthonav.core.records import Fix
    from orthonav.core.track.tracker import Tracker
    from orthonav.ground.recordings.localize import localize_flight
    from orthonav.onboard.run import Locator, SingleViews

    cv2.setNumThreads(1)
    localizer = Localizer(open_map(GOLDEN / "area.onav"))
    locator: Locator = Tracker(localizer) if run == "track" else SingleViews(localizer)
    results = islice(localize_flight(locator, open_flight(GOLDEN / "flight")), views)
    return sum(isinstance(each.outcome, Fix) for each in results)


def row(name: str, run: str, count: float, base: float) -> list[str]:
    """Cells of a row: `count` instructions a view, beside `base` of the first processor."""
    estimates = (f"{1e3 * count / (each * CLOCK_HZ):.0f}" for each in PER_CYCLE)
    return [name, run, f"{count / 1e6:,.0f}", f"{count / base:.2f}", *estimates]


def _per_view(measured: Measure, processor: Processor, run: str, views: int) -> float:
    """A measure of N views taken from that of 2 N, by N."""
    once, twice = (measured(processor, run, count) for count in (views, 2 * views))
    return (twice - once) / views


def _instructions(processor: Processor, run: str, views: int) -> float:
    """Instructions of a process. Raises `RuntimeError` where none were counted."""
    done = _started(processor, run, views)
    counted = COUNTED.findall(done.stderr)
    if len(counted) != 1:
        raise RuntimeError(f"{processor.name} counted nothing: {done.stderr[-2000:]}")
    return float(counted[0].replace(",", ""))


def _processor_s(processor: Processor, run: str, views: int) -> float:
    """Seconds of the processor, user and system."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    _started(processor, run, views)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _started(processor: Processor, run: str, views: int) -> "subprocess.CompletedProcess[str]":
    """A process that located its views. Raises `RuntimeError` where it placed less than all."""
    alike = {"OPENBLAS_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT / "src"), **alike}
    done = subprocess.run(
        [*processor.command, str(HERE / "instructions.py"), "--child", run, str(views)],
        env={**environment, **processor.environment},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode or json.loads(done.stdout) != views:
        raise RuntimeError(f"{processor.name}: {done.stdout} of {views}: {done.stderr[-2000:]}")
    return done


def _native() -> Processor:
    return Processor("this machine", [sys.executable])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path("build/arm64"))
    parser.add_argument("--views", type=int, default=9, help="N; 2 N must be in the stored flight")
    parser.add_argument("--run", nargs="+", choices=RUNS, default=RUNS, help="default: both")
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
