"""Single and tracked views of real ground: relief, houses and trees, lenses, recorded flights.

`python -m benchmarks.real_ground --work DIR [--part flights relief ..] [--only TEXT ..]
[--views 40] [--workers 1]` prints a row for each map and kind of view, and compares tracks with
single views of the same flight; rerun to resume.
`--gate` runs a compact part against the figures of `gate.json` and fails where one is worse;
`--gate --renew` writes them.
"""

import sys

from benchmarks.real_ground.measure import add, measure
from benchmarks.record import run

if __name__ == "__main__":
    sys.exit(run(measure, add))
