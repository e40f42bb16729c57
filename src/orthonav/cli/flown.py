"""A flight log told again: how it was flown against how it is flown now."""

import argparse
import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from orthonav.flight.mount import Mount
    from orthonav.records import ViewResult
    from orthonav.sources import Recording

log = logging.getLogger(__name__)
_CHOICES = {
    "heading": ("known", "unknown"),
    "prior": ("telemetry", "none"),
    "registration": ("on", "off"),
    "position": ("peak", "best", "neighbours", "weighted"),
}


def take_flown(options: argparse.Namespace, flight: "Recording") -> "Mount | None":
    """The mount to fly with; with `--as-flown` the logged options take the place of `options`.

    Without, or where the map is another, what differs is warned about. Raises `FlightError` where
    options that were logged cannot be.
    """
    from orthonav.errors import FlightError
    from orthonav.flight.mount import read_mount
    from orthonav.sources import LoggedFlight

    mount: Mount | None = read_mount(options.mount) if options.mount else None
    if not isinstance(flight, LoggedFlight):
        if options.as_flown:
            raise FlightError(f"--as-flown is for flight logs: {flight.path}")
        return mount
    _check_map(options, flight.session.get("map"))
    flown = _flown(flight.session.get("options"))
    told: dict[str, Any] = {name: getattr(options, name) for name in (*_CHOICES, "accept")}
    told["track"] = options.track or options.smooth
    told["mount"] = mount
    differ = [name for name in told if name in flown and flown[name] != told[name]]
    if options.as_flown:
        for name in (*_CHOICES, "accept", "track"):
            setattr(options, name, flown.get(name, getattr(options, name)))
        options.skip_bad_images = True  # a flight goes on where the camera gave no picture
        return flown.get("mount", mount)
    if differ:
        log.warning(
            "not flown like this in flight, where %s differed: --as-flown does it again",
            ", ".join(differ),
        )
    return mount


def tell_whether_as_flown(flight: "Recording", results: Sequence["ViewResult"]) -> None:
    """Log how many results are not those of the flight; for a replay of a log."""
    from orthonav.sources import LoggedFlight

    if not isinstance(flight, LoggedFlight):
        return
    logged = {result.frame: _answer(result) for result in flight.results()}
    both = [result for result in results if result.frame in logged]
    other = [result.frame for result in both if logged[result.frame] != _answer(result)]
    if other:
        told = len(other), len(both), other[0]
        log.warning("%d of %d results are not those of the flight, the first: %s", *told)
    else:
        log.info("all %d results are those of the flight", len(both))


def _answer(result: "ViewResult") -> str:
    """A result without the time it took."""
    from dataclasses import replace

    from orthonav.flight.fixes import result_to_json

    return result_to_json(replace(result, latency_ms=0.0))


def _check_map(options: argparse.Namespace, logged: Any) -> None:
    from orthonav.mapfile.signature import map_digest

    flown = logged.get("manifest_sha256") if isinstance(logged, dict) else None
    if flown is not None and flown != map_digest(options.map):
        log.warning("flown with another map in flight (%.80s): %s", logged.get("name"), options.map)


def _flown(logged: Any) -> dict[str, Any]:
    """What a log says of how it was flown, checked: a log may come from a stranger."""
    from orthonav.errors import FlightError

    if not isinstance(logged, dict):
        return {}
    found: dict[str, Any] = {}
    for name, choices in _CHOICES.items():
        if name in logged:
            if logged[name] not in choices:
                raise FlightError(f"flight log has no such option: {name} {logged[name]!r:.40}")
            found[name] = logged[name]
    for name, kinds in (("accept", str | None), ("track", bool)):
        if name in logged:
            if not isinstance(logged[name], kinds):
                raise FlightError(f"flight log has no such option: {name} {logged[name]!r:.40}")
            found[name] = logged[name]
    if "mount" in logged:
        found["mount"] = None if logged["mount"] is None else _mount(logged["mount"])
    return found


def _mount(plain: Any) -> "Mount":
    from orthonav.errors import FlightError
    from orthonav.flight.mount import BROKEN, mount_from_plain

    try:
        return mount_from_plain(plain)
    except BROKEN as error:
        raise FlightError(f"flight log has a mount that is none ({error!r:.80})") from error
