"""`python -m benchmarks.closed_loop replays|fly --work DIR`: see docs/closed-loop.md."""

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2

from benchmarks.closed_loop import replays, report
from benchmarks.closed_loop.inertial import FILTERS
from benchmarks.closed_loop.physics import VEHICLES
from benchmarks.record import Section, provenance, save


def main(arguments: Sequence[str]) -> int:
    """Run one part, print its tables, store them in `--out`; returns the exit code."""
    options = _parser().parse_args(arguments)
    cv2.setNumThreads(1)
    started, begin = provenance(f"closed-loop-{options.part}"), time.perf_counter()
    section: Section = options.run(options)
    if not section.tables:
        print("the recorded flights beside the checkout (closed_loop) are absent", file=sys.stderr)
        return 1
    print(section.markdown())
    wall_s = time.perf_counter() - begin
    save(options.out, [section], started, wall_s=wall_s, latest=False)
    return 0


def _replays(options: argparse.Namespace) -> Section:
    return replays.measure(
        options.work,
        options.only,
        methods=options.methods,
        rule=replays.plain if options.plain else replays.stated,
        views=options.views,
        disturbed=not options.undisturbed,
    )


def _fly(options: argparse.Namespace) -> Section:
    return report.measure(
        options.work,
        vehicle=options.vehicle,
        autopilot=options.filter,
        send=options.send,
        minutes=options.minutes,
        seeds=options.seed,
        rule=replays.plain if options.plain else replays.stated,
        only=options.only,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.closed_loop", description=(__doc__ or "").splitlines()[0]
    )
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--work", type=Path, required=True, help="folder of demo and pictures")
    common.add_argument("--out", type=Path, default=Path("bench_results"), help="of the results")
    common.add_argument(
        "--plain", action="store_true", help="no deviations in the telemetry, as in 0.1"
    )
    parts = parser.add_subparsers(dest="part", required=True)
    again = parts.add_parser("replays", parents=[common], help="recorded flights located again")
    again.set_defaults(run=_replays)
    again.add_argument("--only", nargs="+", default=(), metavar="FLIGHT")
    again.add_argument("--methods", nargs="+", default=replays.METHODS, choices=replays.METHODS)
    again.add_argument("--views", type=int, help="only the first so many views without GNSS")
    again.add_argument("--undisturbed", action="store_true", help="end before any disturbance")
    loop = parts.add_parser("fly", parents=[common], help="simulated flights on what is sent")
    loop.set_defaults(run=_fly)
    loop.add_argument("--vehicle", choices=VEHICLES, default="plane")
    loop.add_argument("--filter", choices=FILTERS, default="px4", help="instruments and tuning")
    loop.add_argument("--send", choices=("position", "position+velocity"), default="position")
    loop.add_argument("--minutes", type=float, default=10.0, help="without GNSS (default 10)")
    loop.add_argument("--seed", type=int, nargs="+", default=[1], help="one flight each")
    loop.add_argument("--only", nargs="+", default=report.SCENARIOS, choices=report.SCENARIOS)
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
