"""`orthonav fly --gnss`: the witness, made from the options."""

import argparse
from collections import deque
from pathlib import Path

from orthonav.errors import VariantError
from orthonav.flight.gnss import FILE, GnssSample, read_gnss
from orthonav.geo.frames import LocalFrame
from orthonav.mapfile.signature import map_digest
from orthonav.onboard.gnss.watch import (
    GnssSource,
    GnssWatch,
    LiveSolutions,
    RecordedSolutions,
)
from orthonav.onboard.state import displacements
from orthonav.onboard.telemetry import Clocks


def gnss_watch(
    options: argparse.Namespace,
    frame: LocalFrame,
    queue: deque[GnssSample] | None,
    min_confidence: float,
    clocks: Clocks,
) -> GnssWatch:
    """Witness over the solutions in `queue`, or over `gnss.csv` of the flight folder.

    Raises `VariantError` where GNSS has no source, or `correct` no state.
    """
    if options.gnss == "correct" and options.state is None:
        raise VariantError("--gnss correct needs --state FILE with the displacement of the map")
    recorded = options.recorded_telemetry and not options.ros2
    source: GnssSource
    if recorded:
        source = RecordedSolutions(read_gnss(Path(options.source) / FILE))
    elif queue is None:
        raise VariantError("--gnss needs --autopilot, --ros2 or --recorded-telemetry")
    else:
        source = LiveSolutions(queue)

    return GnssWatch(
        frame,
        source,
        digest=map_digest(options.map),
        known=displacements(options.state) if options.state else {},
        correct=options.gnss == "correct",
        recorded=recorded,
        min_confidence=min_confidence,
        utc_ahead_ns=lambda: 0 if recorded else clocks.utc_ns() - clocks.mono_ns(),
    )
