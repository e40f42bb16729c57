"""`orthonav localize`: find the positions of the views of a flight."""

import argparse
import json
import logging
import math
from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli.changed import (
    add_report_changes,
    changes_text,
    changes_to_plain,
    check_comparable,
    report_changes,
)
from orthonav.cli.common import (
    Progress,
    add_search,
    beside,
    counted,
    print_json,
    progress,
    search_plan,
)
from orthonav.cli.heights import dem_of, flight_heights, say_assumed_heights
from orthonav.cli.needs import require_extras
from orthonav.cli.setups import SetupAdvice
from orthonav.cli.signed import add_signature, checked_signature
from orthonav.cli.source import add_source, open_source, warn_if_far_from_map

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from orthonav.core.flight.fixes import Identity
    from orthonav.core.flight.heights import FlownHeights
    from orthonav.core.flight.mount import Mount
    from orthonav.core.localize import Localizer
    from orthonav.core.localize.confidence import Acceptance
    from orthonav.core.mapfile import MapFile
    from orthonav.core.records import Fix, ViewResult
    from orthonav.ground.changes.record import ChangedGround
    from orthonav.ground.recordings import Recording, SourceView
    from orthonav.onboard.run import Locator

EVERYDAY = (
    "--heading",
    "--prior",
    "--track",
    "--smooth",
    "--accept",
    "--mount",
    "--atlas",
    "--camera",
    "--fov-deg",
    "--agl-m",
    "--dem",
    "--json",
)

log = logging.getLogger(__name__)

_HINTS = (
    ("yaw_deg", "give --heading unknown"),
    ("agl_m", "give --agl-m"),
    ("pitch_deg", "give --looks-down"),
)
"""What to do about a value that is missing."""


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("map", metavar="MAP.onav", help="map, or with --atlas an atlas")
    parser.add_argument(
        "flight",
        type=Path,
        nargs="+",
        metavar="SOURCE",
        help="flight folder, photographs, video or ROS recording, as for `orthonav import`",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="fixes.jsonl",
        help="file to write (-: stdout, with the summary on stderr); without it the command prints "
        "the positions, if photographs are given one by one",
    )
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.add_argument(
        "--no-diagnosis",
        dest="diagnosis",
        action="store_false",
        help="if few views are confident, do not try other headings and heights to find the cause",
    )
    _add_views(parser.add_argument_group("placing views"))
    _add_track(parser.add_argument_group("tracking"))
    _add_outputs(parser.add_argument_group("further outputs"))
    add_signature(parser.add_argument_group("signed maps"))
    add_source(parser)


def _add_views(group: argparse._ActionsContainer) -> None:
    """How each view is searched for, and which fixes count as confident."""
    group.add_argument(
        "--heading",
        choices=("known", "unknown"),
        default="known",
        help="known: from telemetry (default); unknown: all headings are tried",
    )
    group.add_argument(
        "--prior",
        choices=("telemetry", "none"),
        default="telemetry",
        help="telemetry: search around the prior position in the telemetry, if any (default); "
        "none: search the whole map",
    )
    group.add_argument(
        "--accept",
        metavar="NAME:MIN",
        default="confidence:0.9",
        help="criterion of a confident fix and its threshold: confidence:0.9 (default), "
        "peak_ratio:1.3, or the paper's lowe_ratio:1.13 (with --registration off); other fixes are "
        'written too, marked "confident": false',
    )
    group.add_argument(
        "--atlas",
        action="store_true",
        help="the first argument is an atlas (folder or URL); no prior is used, and a fix needs "
        "the agreement of several views",
    )
    group.add_argument(
        "--registration",
        choices=("on", "off"),
        default="on",
        help="on: positions within a pixel, where the map has a registration layer (default); off: "
        "positions at tile level, as in the paper",
    )
    group.add_argument(
        "--position",
        choices=("peak", "best", "neighbours", "weighted"),
        default="peak",
        help="with --registration off, how scores become a position: interpolated peak (default), "
        "best tile (the paper), mean of the best tile and its neighbours, or weighted mean of all",
    )
    add_search(group)
    group.add_argument(
        "--skip-bad-images",
        action="store_true",
        help="write images that are missing or cannot be decoded as no_fix instead of stopping",
    )


def _add_track(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--track",
        action="store_true",
        help="track the aircraft: every position also uses the views before it",
    )
    group.add_argument(
        "--smooth",
        action="store_true",
        help="track, then smooth: every position uses all views of the flight",
    )
    group.add_argument(
        "--lag",
        type=int,
        metavar="VIEWS",
        help="with --smooth: number of later views that a position uses (default: all)",
    )
    group.add_argument(
        "--mount",
        type=Path,
        metavar="mount.json",
        help="correct heading, height and tilt with a calibration by `orthonav calibrate`",
    )
    group.add_argument(
        "--as-flown",
        action="store_true",
        help="flight log: use the options of the flight",
    )


def _add_outputs(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--export",
        action="append",
        default=[],
        metavar="FORMAT=PATH",
        help="write the confident camera positions for other programs too: csv, kml, gpx, "
        "tum (a trajectory for evo) or odm-geo (OpenDroneMap's geo.txt); heights above sea need a "
        "terrain; can be repeated",
    )
    add_report_changes(group)


def run(options: argparse.Namespace) -> None:
    _check_destination(options)
    if options.atlas:
        _on_atlas(options)
    else:
        options.map = Path(options.map)
        _on_map(options)


def _on_map(options: argparse.Namespace) -> None:
    from orthonav.core.errors import VariantError
    from orthonav.core.flight.fixes import FlightDigest, Identity
    from orthonav.core.flight.mount import MountedFlight
    from orthonav.core.localize.confidence import Acceptance
    from orthonav.core.mapfile import open_map
    from orthonav.core.mapfile.terrain import TerrainLayer
    from orthonav.core.track.tracker import Tracker
    from orthonav.ground.recordings.export import export_all, export_of
    from orthonav.ground.recordings.flightlog import compare_with_flight
    from orthonav.ground.recordings.localize import smoothed_track
    from orthonav.onboard.run import Locator, MountCorrected, SingleViews, model_of

    if options.lag is not None and not (options.smooth and options.lag >= 0):
        raise VariantError("--lag needs --smooth and a number of views, 0 or more")
    exports = [export_of(each) for each in options.export]
    signature = checked_signature(options)
    dem = dem_of(options)
    opened = open_map(options.map, signature.manifest_sha256 if signature else None)
    over_terrain = dem is not None or opened.manifest.sheets[0].terrain is not None
    flight = open_source(options.flight, options, over_terrain=over_terrain)
    mount = _take_flown(options, flight)
    accept = Acceptance.parse(options.accept)
    localizer = _localizer(options, opened, accept)
    check_comparable(options, localizer.registration, opened)
    warn_if_far_from_map(flight, localizer)
    how = {
        "use_prior": options.prior == "telemetry",
        "heading_known": options.heading == "known",
    }
    locator: Locator = SingleViews(localizer, **how)
    tracker = None
    if options.track or options.smooth:
        model = model_of(mount) if mount else None
        locator = tracker = Tracker(
            localizer, smooth=options.smooth, lag=options.lag, model=model, **how
        )
    if mount:
        locator = MountCorrected(locator, mount)
    heights = flight_heights(options, opened, flight, dem)
    advisor, digest = SetupAdvice(options, flight, localizer, mount, heights), FlightDigest()
    with progress(options) as shown:
        views = digest.watching(advisor.watching())
        results = _located(options, locator, flight, accept, views, shown, heights, advisor.take)
        if tracker is not None and options.smooth:
            results = smoothed_track(tracker, results, accept)
        else:
            compare_with_flight(flight, results)
        _write_positions(options, results, Identity(opened.manifest.sha256, digest.sha256))
        export_all(exports, results, dem or TerrainLayer.of(opened))
        advice, tried = advisor.advice(results, accept)
        seen_by = MountedFlight(flight, mount) if mount else flight
        changed = report_changes(options, opened, [(seen_by, results)], shown)
    with _beside_outputs(options):
        _print_summary(options, results, accept, advice, tried, changed)


def _localizer(options: argparse.Namespace, opened: "MapFile", accept: "Acceptance") -> "Localizer":
    """The localizer of a map; raises `VariantError` where the criterion does not fit it."""
    from orthonav.core.errors import VariantError
    from orthonav.core.localize import Localizer
    from orthonav.core.tiles.position import check_rule

    made = Localizer(
        opened,
        registration=options.registration == "on",
        position=check_rule(options.position),
        plan=search_plan(options),
    )
    if made.registration is not None and accept.criterion == "lowe_ratio":
        raise VariantError("--accept lowe_ratio compares tiles: it needs --registration off")
    if made.registration is None and options.registration == "on":
        log.warning("the map has no registration layer: positions are at tile level")
    return made


def _on_atlas(options: argparse.Namespace) -> None:
    """Localize on an atlas without a prior; a fix needs the agreement of several views."""
    require_extras("localize --atlas")
    from orthonav.core.errors import VariantError
    from orthonav.core.flight.fixes import FlightDigest, Identity
    from orthonav.core.localize.confidence import Acceptance
    from orthonav.ground.atlas.catalog import Atlas
    from orthonav.ground.atlas.locate import AtlasLocator
    from orthonav.ground.atlas.search import SheetRegistrar, TileSearch
    from orthonav.ground.recordings.export import export_all, export_of

    asked = [
        name
        for name in (
            *("track", "smooth", "mount", "as_flown", "require_signed", "not_before", "lag"),
            *("dem", "dem_datum", "report_changes"),
        )
        if getattr(options, name) not in (None, False)
    ]
    asked += ["position"] if options.position != "peak" else []
    if asked or options.registration == "off":
        named = ", ".join(f"--{name.replace('_', '-')}" for name in asked) or "--registration off"
        raise VariantError(f"{named} needs a map: cut one out of the atlas (orthonav atlas cut)")
    accept = Acceptance.parse(options.accept)
    if accept.criterion == "lowe_ratio":
        raise VariantError("--accept lowe_ratio needs a map and --registration off")
    exports = [export_of(each) for each in options.export]
    flight = open_source(options.flight, options)
    say_assumed_heights(flight, advice="cut a map with terrain out of the atlas")
    digest = FlightDigest()
    search = TileSearch(Atlas.open(options.map))
    with progress(options) as shown:
        if search.unknown:
            log.warning(
                "%d sheets are missing from the index and are not searched; update it with "
                "'orthonav atlas index'",
                len(search.unknown),
            )
        locator = AtlasLocator(
            SheetRegistrar(search.atlas), search, heading_known=options.heading == "known"
        )
        views = digest.watching(flight.views)
        results = _located(options, locator, flight, accept, views, shown)
    _write_positions(options, results, Identity(flight_sha256=digest.sha256))
    export_all(exports, results, None)
    with _beside_outputs(options):
        _print_summary(options, results, accept)


def _located(
    options: argparse.Namespace,
    locator: "Locator",
    flight: "Recording",
    accept: "Acceptance",
    views: "Iterable[SourceView]",
    shown: Progress,
    heights: "FlownHeights | None" = None,
    take: "Callable[[ViewResult], None]" = lambda result: None,
) -> "list[ViewResult]":
    """Results of the views; `take` gets each."""
    from orthonav.ground.recordings.localize import localize_flight

    results = []
    for result in localize_flight(
        locator,
        flight,
        skip_bad_images=options.skip_bad_images,
        accept=accept,
        heights=heights,
        views=views,
    ):
        results.append(result)
        take(result)
        if flight.expected:
            shown("localize", min(1.0, len(results) / flight.expected))
    return results


@contextmanager
def _beside_outputs(options: argparse.Namespace) -> "Iterator[None]":
    """What is printed goes to stderr where an output is stdout."""
    outputs = [options.out, options.report_changes]
    outputs += [Path(each.partition("=")[2]) for each in options.export]
    with beside(*outputs):
        yield


def _print_summary(
    options: argparse.Namespace,
    results: "list[ViewResult]",
    accept: "Acceptance",
    advice: Sequence[str] = (),
    tried: Sequence[dict[str, Any]] = (),
    changed: "ChangedGround | None" = None,
) -> None:
    import numpy as np

    from orthonav.core.files import is_stdout
    from orthonav.ground.recordings.setups import Counts

    counts = Counts.of(results)
    latencies = np.array([result.latency_ms for result in results])
    latencies = latencies[np.isfinite(latencies)]
    median_ms = float(np.median(latencies)) if latencies.size else None
    plain = {
        "fixes": None if options.out is None else str(options.out),
        "views": counts.views,
        "n_confident": counts.confident,
        "n_low_confidence": counts.low,
        "n_none": counts.none,
        "reasons": dict(counts.reasons),
        "accept": options.accept,
        "median_latency_ms": None if median_ms is None else round(median_ms, 3),
        "advice": list(advice),
        "setups": list(tried),
        **changes_to_plain(options, changed),
    }
    if options.json:
        print_json(plain | _positions_to_plain(options, results))
        return
    least = f"{accept.criterion.replace('_', ' ')} {accept.threshold:g} or more"
    named = ", ".join(f"{reason} {count}" for reason, count in counts.reasons)
    why = f" ({named})" if named else ""
    print(
        f"{counted(counts.views, 'view')}: {counts.confident} confident ({least}), "
        f"{counts.low} of low confidence, {counts.none} without a position{why}; "
        f"median {median_ms or 0:.1f} ms per view"
    )
    for line in advice:
        print(f"! {line}")
    for each in options.export:
        print(f"{counted(counts.confident, 'camera position')}: {each.partition('=')[2]}")
    guesses = "; positions of low confidence are best guesses, marked as such" * bool(counts.low)
    if options.out is not None:
        print(f"written to {'stdout' if is_stdout(options.out) else options.out}{guesses}")
    for line in changes_text(options, changed):
        print(line)


def _take_flown(options: argparse.Namespace, flight: "Recording") -> "Mount | None":
    """Mount to use; with `--as-flown`, the logged options replace those of `options`.

    Logs a warning where options or the map differ from those of the flight. Raises `FlightError`
    for invalid logged options.
    """
    from orthonav.core.errors import FlightError
    from orthonav.core.flight.mount import read_mount
    from orthonav.ground.recordings import LoggedFlight
    from orthonav.ground.recordings.flightlog import LOCALIZE_CHOICES, logged_options

    mount: Mount | None = read_mount(options.mount) if options.mount else None
    if not isinstance(flight, LoggedFlight):
        if options.as_flown:
            raise FlightError(f"--as-flown needs a flight log: {flight.path}")
        return mount
    _check_map(options, flight.session.get("map"))
    flown = logged_options(flight.session.get("options"))
    chosen: dict[str, Any] = {
        name: getattr(options, name) for name in (*LOCALIZE_CHOICES, "accept")
    }
    chosen["track"] = options.track or options.smooth
    chosen["mount"] = mount
    if flown.get("accept") is None:  # the runner logs every fix, so the default applies
        flown.pop("accept", None)
        chosen.pop("accept")
    differ = [name for name in chosen if name in flown and flown[name] != chosen[name]]
    if options.as_flown:
        for name in (*LOCALIZE_CHOICES, "accept", "track"):
            setattr(options, name, flown.get(name, getattr(options, name)))
        options.skip_bad_images = True  # a flight continues after an image that cannot be decoded
        return flown.get("mount", mount)
    if differ:
        log.warning(
            "options differ from those of the flight (%s); --as-flown uses the logged ones",
            ", ".join(differ),
        )
    return mount


def _check_map(options: argparse.Namespace, logged: Any) -> None:
    from orthonav.core.mapfile.signature import map_digest

    flown = logged.get("manifest_sha256") if isinstance(logged, dict) else None
    if flown is not None and flown != map_digest(options.map):
        log.warning(
            "the log was flown with another map (%.80s): %s", logged.get("name"), options.map
        )


def _check_destination(options: argparse.Namespace) -> None:
    """Raise `VariantError` where positions have no place to go, or share it with the summary."""
    from orthonav.core.errors import VariantError
    from orthonav.core.files import is_stdout
    from orthonav.ground.recordings.photos import is_photo

    if options.out is not None and is_stdout(options.out) and options.json:
        raise VariantError("--out - and --json both write to stdout: give one of them")
    if options.out is None:
        named = [path for path in options.flight if not path.is_file() or not is_photo(path)]
        if named and all(path.exists() for path in named):
            raise VariantError("give --out FILE, or --out - for stdout")


def _write_positions(
    options: argparse.Namespace, results: "Sequence[ViewResult]", identity: "Identity"
) -> None:
    """Write one line of JSON per view to the file or to stdout, or print them for people."""
    from orthonav.core.flight.fixes import write_results

    if options.out is not None:
        write_results(options.out, results, identity)
    elif not options.json:
        for result in results:
            print(_position_text(result))


def _positions_to_plain(
    options: argparse.Namespace, results: "Sequence[ViewResult]"
) -> dict[str, Any]:
    """The positions as JSON values, where they are written nowhere else."""
    from orthonav.core.flight.fixes import result_to_json

    if options.out is not None:
        return {}
    return {"positions": [json.loads(result_to_json(result)) for result in results]}


def _position_text(result: "ViewResult") -> str:
    """The position of one view in words, over several lines."""
    from orthonav.core.records import Fix

    outcome = result.outcome
    if isinstance(outcome, Fix):
        lines = _lines(outcome, result.is_confident)
    else:
        hints = [f"; {hint}" for name, hint in _HINTS if name in outcome.detail]
        lines = [("position", f"none: {outcome.detail} ({outcome.reason}){''.join(hints)}")]
    return "\n".join([result.frame, *(f"  {name:<11}{text}" for name, text in lines)])


def _lines(fix: "Fix", confident: bool) -> list[tuple[str, str]]:
    east_m, north_m = (math.sqrt(float(fix.cov_en_m2[i, i])) for i in (0, 1))
    judged = "confident" if confident else "low confidence: this is a best guess"
    confidence = judged
    if math.isfinite(fix.confidence):
        confidence = f"{fix.confidence:.2f} that the error is below {fix.radius_m:.0f} m ({judged})"
    return [
        ("position", f"{fix.lat_deg:.7f}, {fix.lon_deg:.7f} (latitude, longitude, WGS 84)"),
        ("deviation", f"{east_m:.1f} m east, {north_m:.1f} m north (1 sigma)"),
        ("confidence", confidence),
        ("heading", f"{fix.heading_deg:.1f} deg from true north, of the top of the image"),
        ("height", f"{fix.agl_m:.1f} m above ground"),
    ]
