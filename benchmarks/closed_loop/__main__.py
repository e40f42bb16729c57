"""`python -m benchmarks.closed_loop replays|fly --work DIR`: see docs/closed-loop.md."""

import argparse
import sys

from benchmarks.closed_loop import loop, replays
from benchmarks.closed_loop.inertial import FILTERS
from benchmarks.closed_loop.physics import VEHICLES
from benchmarks.record import Section, run


def measure(options: argparse.Namespace) -> Section:
    parts = {"replays": replays.measure, "fly": loop.measure}
    section = parts[options.part](options)
    if not section.tables:
        print("the recorded flights beside the checkout (closed_loop) are absent", file=sys.stderr)
        section.failed = True
    return section


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("part", choices=("replays", "fly"))
    parser.add_argument("--only", nargs="+", metavar="NAME", help="flights, or scenarios of fly")
    parser.add_argument("--plain", action="store_true", help="no deviations in the telemetry")
    again = parser.add_argument_group("replays: recorded flights located again")
    again.add_argument("--methods", nargs="+", default=replays.METHODS, choices=replays.METHODS)
    again.add_argument("--views", type=int, help="only the first so many views without GNSS")
    flown = parser.add_argument_group("fly: simulated flights on what is sent")
    flown.add_argument("--vehicle", choices=VEHICLES, default="plane")
    flown.add_argument("--filter", choices=FILTERS, default="px4", help="instruments and tuning")
    flown.add_argument("--send", choices=("position", "position+velocity"), default="position")
    flown.add_argument("--minutes", type=float, default=10.0, help="without GNSS (default 10)")
    flown.add_argument("--seed", type=int, nargs="+", default=[1], help="one flight each")


if __name__ == "__main__":
    sys.exit(run(measure, add))
