"""Flights in a simulated loop: `python -m benchmarks.closed_loop`, see docs/closed-loop.md."""

import sys

from benchmarks.closed_loop.loop import add, measure
from benchmarks.record import run

if __name__ == "__main__":
    sys.exit(run(measure, add))
