"""`orthonav fly --gnss`: the GNSS monitor, made from the options."""

import argparse
import hashlib
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from orthonav.core.errors import VariantError
from orthonav.core.flight.gnss import FILE, GnssSample, read_gnss
from orthonav.core.geo.frames import LocalFrame
from orthonav.onboard.gnss.biases import Biases
from orthonav.onboard.gnss.learner import Resumed
from orthonav.onboard.gnss.watch import (
    GnssSource,
    GnssWatch,
    LiveSolutions,
    RecordedSolutions,
)
from orthonav.onboard.state import before_the_flight, boot_id, learnt_biases, load
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
        raise VariantError("--gnss correct needs --state FILE with biases of earlier flights")
    recorded = options.recorded_telemetry and not options.ros2
    source: GnssSource
    if recorded:
        source = RecordedSolutions(read_gnss(Path(options.source) / FILE))
    elif queue is None:
        raise VariantError("--gnss needs --autopilot, --ros2 or --recorded-telemetry")
    else:
        source = LiveSolutions(queue)

    known, resumed = _learnt_before(options, digest, clocks)
    return GnssWatch(
        frame,
        source,
        digest=digest,
        known=known,
        resumed=resumed,
        setup=hashlib.sha256(repr(used).encode()).hexdigest()[:16],
        correct=options.gnss == "correct",
        recorded=recorded,
        min_confidence=min_confidence,
        utc_ahead_ns=lambda: 0 if recorded else clocks.utc_ns() - clocks.mono_ns(),
    )


def _learnt_before(
    options: argparse.Namespace, digest: str, clocks: Clocks
) -> tuple[Mapping[str, Biases], Resumed | None]:
    """What was learnt before this flight, and by it, where it was interrupted.

    A state is that of this flight if the program that saved it stopped no longer than
    `--state-max-age-s` ago, or at an unknown time because a clock was set back.
    """
    if options.state is None:
        return {}, None
    saved = load(options.state)
    if saved is not None:
        stopped_s = saved.stopped_s(clocks.utc_ns(), clocks.mono_ns(), boot_id())
        if stopped_s > options.state_max_age_s:
            return learnt_biases(options.state), None
    return before_the_flight(options.state, digest)
