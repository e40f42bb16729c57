"""A playback as fast as the program places its images, on a machine of any speed.

As a script: `orthonav` with the arguments that come after those of the files of lines and release.
Once a position was sent, it waits for the latter file.
"""

import json
import sys
from pathlib import Path


def pace_by(lines, is_held=lambda: False):
    """A pace that waits until a line was written for every earlier image, and while it is held."""

    def pace(clocks, factor):
        given = []

        def due_ns(time_ns):
            written = lines.read_text().count('"frame"') if lines.exists() else 0
            if written < len(given) or is_held():
                return None
            given.append(time_ns)
            return clocks.mono_ns()

        return due_ns

    return pace


if __name__ == "__main__":
    from orthonav.cli import main
    from orthonav.onboard import cameras, fly

    lines, release = map(Path, sys.argv[1:3])

    def is_held():
        if release.exists() or not lines.exists():
            return False
        found = lines.read_text().splitlines(keepends=True)
        whole = [json.loads(each) for each in found if each.endswith("\n")]
        return any("frame" in each and each["sent"] for each in whole)

    cameras.own_pace, fly.TELEMETRY_WAIT_S, fly.MAX_AGE_S = pace_by(lines, is_held), 10.0, 60.0
    cameras.autopilot_pace = lambda boot_ns, clocks, factor: cameras.own_pace(clocks, factor)
    sys.exit(main(sys.argv[3:]))
