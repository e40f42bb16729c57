"""`orthonav localize`: find where the views of a flight were taken."""

import argparse
import logging
from pathlib import Path
from typing import TYPE_CHECKING

from orthonav.cli.common import print_json, progress
from orthonav.cli.flown import take_flown, tell_whether_as_flown
from orthonav.cli.needs import require_extras
from orthonav.cli.source import add_source, open_source

if TYPE_CHECKING:
    from orthonav.records import ViewResult

EVERYDAY = (
    "--heading",
    "--prior",
    "--track",
    "--smooth",
    "--accept",
    "--mount",
    "--atlas",
    "--camera",
    "--json",
)

log = logging.getLogger(__name__)


def add(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("map", metavar="MAP.onav", help="map, or with --atlas an atlas")
    parser.add_argument(
        "flight",
        type=Path,
        metavar="SOURCE",
        help="flight folder, photographs, video or ROS recording, as for `orthonav import`",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="fixes.jsonl")
    parser.add_argument(
        "--atlas",
        action="store_true",
        help="the first argument is an atlas (folder or URL), of which nothing is known before: "
        "no prior is used, and only what several views agree on is a fix",
    )
    parser.add_argument(
        "--heading",
        choices=("known", "unknown"),
        default="known",
        help="known: from telemetry (default); unknown: all headings are tried",
    )
    parser.add_argument(
        "--prior",
        choices=("telemetry", "none"),
        default="telemetry",
        help="telemetry: search where its prior columns say, if it has them (default)",
    )
    parser.add_argument(
        "--registration",
        choices=("on", "off"),
        default="on",
        help="on: metres, where the map carries a registration layer (default); off: tiles only",
    )
    parser.add_argument(
        "--position",
        choices=("peak", "best", "neighbours", "weighted"),
        default="peak",
        help="with --registration off, from scores to a position: peak between tiles (default), "
        "best tile (the paper), mean of the best and its neighbours, or of all tiles, weighted",
    )
    parser.add_argument(
        "--accept",
        metavar="NAME:MIN",
        help="withhold fixes below a threshold: confidence:0.9, peak_ratio:1.3, or the paper's "
        "lowe_ratio:1.13 (with --registration off); default: all are written",
    )
    parser.add_argument(
        "--skip-bad-images",
        action="store_true",
        help="images that cannot be decoded become no_fix instead of an error",
    )
    parser.add_argument(
        "--track",
        action="store_true",
        help="follow the aircraft: every position rests on all views before it",
    )
    parser.add_argument(
        "--smooth",
        action="store_true",
        help="track, then place every view by all views of the flight, also those after it",
    )
    parser.add_argument(
        "--lag",
        type=int,
        metavar="VIEWS",
        help="with --smooth: only so many views after each one (default: all)",
    )
    parser.add_argument(
        "--mount",
        type=Path,
        metavar="mount.json",
        help="what `orthonav calibrate` found: told heading, height and tilt are corrected by it",
    )
    parser.add_argument(
        "--as-flown",
        action="store_true",
        help="of a flight log: with the options that it was flown with",
    )
    parser.add_argument(
        "--require-signed",
        type=Path,
        metavar="public.pem",
        help="refuse a map that was not signed with this key (see `orthonav sign`)",
    )
    add_source(parser)
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def run(options: argparse.Namespace) -> None:
    """Localize and write one line per view."""
    if options.atlas:
        _on_atlas(options)
    else:
        options.map = Path(options.map)
        _on_map(options)


def _on_map(options: argparse.Namespace) -> None:
    from orthonav.confidence.accept import Acceptance
    from orthonav.errors import VariantError
    from orthonav.flight.fixes import write_results
    from orthonav.localizer import Localizer
    from orthonav.localizer.tracker import Tracker
    from orthonav.mapfile import open_map
    from orthonav.mapfile.signature import require_signature
    from orthonav.onboard.calibrate import Mounted, model_of
    from orthonav.onboard.run import Locator, SingleViews, localize_flight, smoothed_track
    from orthonav.search.position import check_rule

    if options.lag is not None and not (options.smooth and options.lag >= 0):
        raise VariantError("--lag is a number of views, for --smooth")
    if options.require_signed:
        require_signature(options.map, options.require_signed)
    flight = open_source(options.flight, options)
    mount = take_flown(options, flight)
    accept = Acceptance.parse(options.accept) if options.accept else None
    localizer = Localizer(
        open_map(options.map),
        registration=options.registration == "on",
        position=check_rule(options.position),
    )
    if localizer.registration is not None and accept and accept.criterion == "lowe_ratio":
        raise VariantError("lowe_ratio compares tiles: give --registration off with it")
    if localizer.registration is None and options.registration == "on":
        log.warning("the map has no registration layer: positions at tile level only")
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
        locator = Mounted(locator, mount)
    results = []
    with progress(options) as shown:
        for result in localize_flight(
            locator, flight, skip_bad_images=options.skip_bad_images, accept=accept
        ):
            results.append(result)
            if flight.expected:
                shown("localize", min(1.0, len(results) / flight.expected))
    if tracker is not None and options.smooth:
        results = smoothed_track(tracker, results, accept)
    else:
        tell_whether_as_flown(flight, results)
    write_results(options.out, results)
    _tell(options, results)


def _on_atlas(options: argparse.Namespace) -> None:
    """Without a prior: only what views agree on is a fix."""
    require_extras("localize --atlas")
    from orthonav.atlas.catalog import Atlas
    from orthonav.atlas.locate import AtlasLocator
    from orthonav.atlas.sheet_registration import SheetRegistrar
    from orthonav.atlas.tile_search import TileSearch
    from orthonav.confidence.accept import Acceptance
    from orthonav.errors import VariantError
    from orthonav.flight.fixes import write_results
    from orthonav.onboard.run import localize_flight

    asked = [
        name
        for name in ("track", "smooth", "mount", "as_flown", "require_signed", "lag")
        if getattr(options, name) not in (None, False)
    ]
    asked += ["position"] if options.position != "peak" else []
    if asked or options.registration == "off":
        named = ", ".join(f"--{name.replace('_', '-')}" for name in asked) or "--registration off"
        raise VariantError(f"{named} is for a map: cut one out of the atlas (orthonav atlas cut)")
    accept = Acceptance.parse(options.accept) if options.accept else None
    if accept and accept.criterion == "lowe_ratio":
        raise VariantError("lowe_ratio compares tiles: it is for a map, with --registration off")
    flight = open_source(options.flight, options)
    results = []
    with TileSearch(Atlas.open(options.map)) as search, progress(options) as shown:
        if search.unknown:
            log.warning(
                "%d sheets are not in the index, so nothing is found there; bring it up to date "
                "with 'orthonav atlas index'",
                len(search.unknown),
            )
        locator = AtlasLocator(
            SheetRegistrar(search.atlas), search, heading_known=options.heading == "known"
        )
        for result in localize_flight(
            locator, flight, skip_bad_images=options.skip_bad_images, accept=accept
        ):
            results.append(result)
            if flight.expected:
                shown("localize", min(1.0, len(results) / flight.expected))
    write_results(options.out, results)
    _tell(options, results)


def _tell(options: argparse.Namespace, results: "list[ViewResult]") -> None:
    """Print the summary."""
    import numpy as np

    from orthonav.records import Fix

    fixes = sum(isinstance(result.outcome, Fix) for result in results)
    latencies = np.array([result.latency_ms for result in results])
    latencies = latencies[np.isfinite(latencies)]
    median_ms = float(np.median(latencies)) if latencies.size else None
    plain = {
        "fixes": str(options.out),
        "views": len(results),
        "n_fix": fixes,
        "n_no_fix": len(results) - fixes,
        "median_latency_ms": None if median_ms is None else round(median_ms, 3),
    }
    if options.json:
        print_json(plain)
    else:
        print(
            f"{plain['views']} views: {fixes} fixes, {plain['n_no_fix']} without; "
            f"median {median_ms or 0:.1f} ms per view\nwritten to {options.out}"
        )
