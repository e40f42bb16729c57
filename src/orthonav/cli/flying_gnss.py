"""`orthonav fly --gnss`: the GNSS monitor, made from the options."""

import argparse
import hashlib
from collections import deque
from pathlib import Path
from typing import Any

from orthonav.errors import VariantError
from orthonav.flight.gnss import FILE, GnssSample, read_gnss
from orthonav.geo.frames import LocalFrame
from orthonav.onboard.gnss.watch import (
    GnssSource,
    GnssWatch,
    LiveSolutions,
    RecordedSolutions,
)
from orthonav.onboard.state import learnt_biases
from orthonav.onboard.telemetry import Clocks


def gnss_watch(
    options: argparse.Namespace,
    frame: LocalFrame,
    digest: str,
    used: tuple[Any, ...],
    queue: deque[GnssSample] | None,
    min_confidence: float,
    clocks: Clocks,
) -> GnssWatch:
    """GNSS monitor over the solutions in `queue`, or over `gnss.csv` of the flight folder.

    `digest`: of the map. `used`: camera, its mount and stated latency; after a change of them,
    what they add to the difference is learnt again. Raises `VariantError` where GNSS has no source,
    or `correct` no state.
    """
    if options.gnss == "correct" and options.state is None:
        raise VariantError("--gnss correct needs --state FILE with what was learnt of the map")
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
        digest=digest,
        known=learnt_biases(options.state) if options.state else {},
        setup=hashlib.sha256(repr(used).encode()).hexdigest()[:16],
        correct=options.gnss == "correct",
        recorded=recorded,
        min_confidence=min_confidence,
        utc_ahead_ns=lambda: 0 if recorded else clocks.utc_ns() - clocks.mono_ns(),
    )
