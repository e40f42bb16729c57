"""Replay of a flight log: compare options and results with those of the flight."""

import argparse
import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from orthonav.core.flight.mount import Mount
    from orthonav.core.records import ViewResult
    from orthonav.ground.recordings import Recording

log = logging.getLogger(__name__)
_CHOICES = {
    "heading": ("known", "unknown"),
    "prior": ("telemetry", "none"),
    "registration": ("on", "off"),
    "position": ("peak", "best", "neighbours", "weighted"),
}


def take_flown(options: argparse.Namespace, flight: "Recording") -> "Mount | None":
    """Mount to use; with `--as-flown`, the logged options replace those of `options`.

    Logs a warning where options or the map differ from those of the flight. Raises `FlightError`
    for invalid logged options.
    """
    from orthonav.core.errors import FlightError
    from orthonav.core.flight.mount import read_mount
    from orthonav.ground.recordings import LoggedFlight

    mount: Mount | None = read_mount(options.mount) if options.mount else None
    if not isinstance(flight, LoggedFlight):
        if options.as_flown:
            raise FlightError(f"--as-flown needs a flight log: {flight.path}")
        return mount
    _check_map(options, flight.session.get("map"))
    flown = _flown(flight.session.get("options"))
    chosen: dict[str, Any] = {name: getattr(options, name) for name in (*_CHOICES, "accept")}
    chosen["track"] = options.track or options.smooth
    chosen["mount"] = mount
    if flown.get("accept") is None:  # the runner logs every fix, so the default applies
        flown.pop("accept", None)
        chosen.pop("accept")
    differ = [name for name in chosen if name in flown and flown[name] != chosen[name]]
    if options.as_flown:
        for name in (*_CHOICES, "accept", "track"):
            setattr(options, name, flown.get(name, getattr(options, name)))
        options.skip_bad_images = True  # a flight continues after an image that cannot be decoded
        return flown.get("mount", mount)
    if differ:
        log.warning(
            "options differ from those of the flight (%s); --as-flown uses the logged ones",
            ", ".join(differ),
        )
    return mount


def compare_with_flight(flight: "Recording", results: Sequence["ViewResult"]) -> None:
    """Log how many results of a replay differ from those of the flight."""
    from orthonav.ground.recordings import LoggedFlight

    if not isinstance(flight, LoggedFlight):
        return
    logged = {result.frame: _comparable(result) for result in flight.results()}
    both = [result for result in results if result.frame in logged]
    other = [result.frame for result in both if logged[result.frame] != _comparable(result)]
    if other:
        counts = len(other), len(both), other[0]
        log.warning("%d of %d results differ from those of the flight, first: %s", *counts)
    else:
        log.info("all %d results equal those of the flight", len(both))


def _comparable(result: "ViewResult") -> str:
    """A result as text, without its latency."""
    from dataclasses import replace

    from orthonav.core.flight.fixes import result_to_json

    return result_to_json(replace(result, latency_ms=0.0))


def _check_map(options: argparse.Namespace, logged: Any) -> None:
    from orthonav.core.mapfile.signature import map_digest

    flown = logged.get("manifest_sha256") if isinstance(logged, dict) else None
    if flown is not None and flown != map_digest(options.map):
        log.warning(
            "the log was flown with another map (%.80s): %s", logged.get("name"), options.map
        )


def _flown(logged: Any) -> dict[str, Any]:
    """Options of a log, validated: a log is untrusted input."""
    from orthonav.core.errors import FlightError
    from orthonav.core.flight.mount import logged_mount

    if not isinstance(logged, dict):
        return {}
    found: dict[str, Any] = {}
    for name, choices in _CHOICES.items():
        if name in logged:
            if logged[name] not in choices:
                raise FlightError(f"flight log: invalid option {name}: {logged[name]!r:.40}")
            found[name] = logged[name]
    for name, kinds in (("accept", str | None), ("track", bool)):
        if name in logged:
            if not isinstance(logged[name], kinds):
                raise FlightError(f"flight log: invalid option {name}: {logged[name]!r:.40}")
            found[name] = logged[name]
    if "mount" in logged:
        found["mount"] = logged_mount(logged)
    return found
