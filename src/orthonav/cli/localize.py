"""`orthonav localize`: find the positions of the views of a flight."""

import argparse
import logging
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import orthonav
from orthonav.cli.common import (
    acceptance,
    add_acceptance,
    add_options,
    beside,
    checked_signature,
    counted,
    print_json,
    progress,
    reporter,
    search_plan,
)
from orthonav.cli.source import (
    FAR_M,
    add_source,
    dem_of,
    far_from_map,
    far_text,
    flight_heights,
    located,
    open_source,
    say_assumed_heights,
    warn_if_far_from_map,
)
from orthonav.cli.version import require_extras
from orthonav.core.errors import UsageError
from orthonav.core.files import is_stdout
from orthonav.core.geo.headings import RADIANS, seem_radians

if TYPE_CHECKING:
    from orthonav.core.flight import RecordedView
    from orthonav.core.flight.fixes import Identity
    from orthonav.core.flight.mount import Mount
    from orthonav.core.geo.ground import TerrainHeights
    from orthonav.core.localize.confidence import Acceptance
    from orthonav.core.mapfile.terrain import TerrainLayer
    from orthonav.ground.imagery.terrain import Dem
    from orthonav.ground.recordings import Recording
    from orthonav.ground.recordings.setups import Tried

EXAMPLE = "area.onav flight --out fixes.jsonl"
EVERYDAY = (
    *("--heading", "--prior", "--track", "--smooth", "--accept", "--alert-limit-m", "--mount"),
    *("--camera", "--fov-deg", "--agl-m", "--dem", "--json"),
)
BUDGET_S = 15.0
"""After so long no further view is localized: the search for the cause takes at most 20 s."""
log = logging.getLogger(__name__)


def add(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    text = "map, or an atlas (a folder or URL), on which no prior is used and a fix needs the "
    add("map", metavar="MAP.onav", help=f"{text}agreement of several views")
    text = "flight folder, photographs, video or ROS recording, as for `orthonav import`"
    add("flight", type=Path, nargs="+", metavar="SOURCE", help=text)
    text = "file to write (-: stdout, with the summary on stderr); without it the command prints "
    text += "the positions, if photographs are given one by one"
    add("--out", type=Path, metavar="fixes.jsonl", help=text)
    text = "write the confident camera positions for other programs too: csv, geojson, kml, tum "
    text += "(a trajectory for evo), odm-geo (OpenDroneMap's geo.txt) or exif (a table for "
    text += "exiftool); heights above sea need a terrain; can be repeated"
    add("--export", action="append", default=[], metavar="FORMAT=PATH", help=text)
    add_options(parser, "--json")

    group = parser.add_argument_group("placing views")
    add = group.add_argument
    add_options(group, "--heading", "--prior")
    text = "criterion of a confident fix and its threshold: confidence:0.9 (default), "
    text += "peak_ratio:1.3, or the paper's lowe_ratio:1.13 (positions of tiles); other fixes "
    text += 'are written too, marked "confident": false'
    add_acceptance(group, help=text)
    text = "registered: within a pixel, where the map has a registration layer (default); else by "
    text += "the scores of tiles: interpolated peak, best tile (the paper), mean of the best tile "
    text += "and its neighbours, or weighted mean of all"
    kinds = ("registered", "peak", "best", "neighbours", "weighted")
    add("--position", choices=kinds, default="registered", help=text)
    add_options(group, "--budget-ms", "--threads", "--require-signed", "--not-before")
    text = "write images that are missing or cannot be decoded as no_fix instead of stopping"
    add("--skip-bad-images", action="store_true", help=text)

    group = parser.add_argument_group("tracking")
    add = group.add_argument
    text = "track the aircraft: every position also uses the views before it"
    add("--track", action="store_true", help=text)
    text = "track, then smooth: every position uses all views of the flight"
    add("--smooth", action="store_true", help=text)
    add_options(group, "--mount")
    add("--as-flown", action="store_true", help="flight log: use the options of the flight")
    add_source(parser)


def run(options: argparse.Namespace) -> None:
    _check_destination(options)
    if "://" in options.map or Path(options.map).is_dir():
        _on_atlas(options)
    else:
        options.map = Path(options.map)
        _on_map(options)


def _above_sea(dem: "Dem | None", layer: "TerrainLayer | None") -> "TerrainHeights | None":
    """The terrain, if its heights count from the sea."""
    if dem is not None:
        return dem if dem.datum.is_known else None
    return layer if layer is not None and layer.info.is_above_sea else None


def _on_map(options: argparse.Namespace) -> None:
    from orthonav.core.flight.fixes import FlightDigest, Identity
    from orthonav.core.mapfile.terrain import TerrainLayer
    from orthonav.ground.recordings.export import export_all, export_of
    from orthonav.ground.recordings.flightlog import compare_with_flight
    from orthonav.ground.recordings.localize import smoothed_track
    from orthonav.onboard.run import Locator, MountCorrected, SingleViews, model_of

    exports = [export_of(each) for each in options.export]
    signature = checked_signature(options)
    dem = dem_of(options)
    opened = orthonav.open_map(options.map, signature.manifest_sha256 if signature else None)
    over_terrain = dem is not None or opened.manifest.sheets[0].terrain is not None
    flight = open_source(options.flight, options, over_terrain=over_terrain)
    mount = _take_flown(options, flight)
    accept = acceptance(options)
    localizer = _localizer(options, opened, accept)
    warn_if_far_from_map(flight, localizer)
    how = {
        "use_prior": options.prior == "telemetry",
        "heading_known": options.heading == "known",
    }
    locator: Locator = SingleViews(localizer, **how)
    tracker = None
    if options.track or options.smooth:
        model = model_of(mount) if mount else None
        locator = tracker = orthonav.Tracker(localizer, smooth=options.smooth, model=model, **how)
    if mount:
        locator = MountCorrected(locator, mount)
    heights = flight_heights(options, opened, flight, dem)

    def corrected(telemetry: orthonav.Telemetry) -> orthonav.Telemetry:
        made = telemetry if heights is None else heights.corrected(telemetry)
        return mount.corrected(made) if mount else made

    advisor = SetupAdvice(options, flight, localizer, corrected)
    digest = FlightDigest()
    with progress(options) as shown:
        views = digest.watching(flight.views)
        how_shown = (accept, heights, advisor.take)
        results = located(options, locator, flight, views, shown, *how_shown)
        if tracker is not None and options.smooth:
            results = smoothed_track(tracker, results, accept)
        else:
            compare_with_flight(flight, results)
        _write_positions(options, results, Identity(opened.manifest.sha256, digest.sha256))
        export_all(exports, results, _above_sea(dem, TerrainLayer.of(opened)))
        advice, tried = advisor.advice(results, accept)
    _print_summary(options, results, accept, advice, tried)


def _localizer(
    options: argparse.Namespace, opened: "orthonav.MapFile", accept: "Acceptance"
) -> "orthonav.Localizer":
    """The localizer of a map; raises `UsageError` where the criterion does not fit it."""
    registered = options.position == "registered"
    made = orthonav.Localizer(
        opened,
        registration=registered,
        position="peak" if registered else options.position,
        plan=search_plan(options),
    )
    if made.registration is not None and accept.criterion == "lowe_ratio":
        raise UsageError("--accept lowe_ratio compares tiles: it needs --position peak or best")
    if made.registration is None and registered:
        log.warning("the map has no registration layer: positions are at tile level")
    return made


def _on_atlas(options: argparse.Namespace) -> None:
    """Localize on an atlas without a prior; a fix needs the agreement of several views."""
    require_extras("localize ATLAS")
    from orthonav.core.flight.fixes import FlightDigest, Identity
    from orthonav.ground.atlas.catalog import Atlas
    from orthonav.ground.atlas.locate import AtlasLocator, SheetSearch
    from orthonav.ground.recordings.export import export_all, export_of

    of_maps = (
        *("track", "smooth", "mount", "as_flown", "require_signed", "not_before"),
        *("dem", "dem_datum"),
    )
    asked = [name for name in of_maps if getattr(options, name)]
    asked += ["position"] * (options.position != "registered")
    if asked:
        named = ", ".join(f"--{name.replace('_', '-')}" for name in asked)
        raise UsageError(f"{named} needs a map: cut one out of the atlas (orthonav atlas cut)")
    accept = acceptance(options)
    if accept.criterion == "lowe_ratio":
        raise UsageError("--accept lowe_ratio needs a map and --position peak or best")
    exports = [export_of(each) for each in options.export]
    flight = open_source(options.flight, options)
    say_assumed_heights(flight, advice="cut a map with terrain out of the atlas")
    digest = FlightDigest()
    search = SheetSearch(Atlas.open(options.map))
    locator = AtlasLocator(search, heading_known=options.heading == "known")
    with progress(options) as shown:
        views = digest.watching(flight.views)
        results = located(options, locator, flight, views, shown, accept)
    _write_positions(options, results, Identity(flight_sha256=digest.sha256))
    export_all(exports, results, None)
    _print_summary(options, results, accept)


def _print_summary(
    options: argparse.Namespace,
    results: "list[orthonav.ViewResult]",
    accept: "Acceptance",
    advice: Sequence[str] = (),
    tried: Sequence[dict[str, Any]] = (),
) -> None:
    """Print, on stderr where an output is stdout, how many views have positions and why not."""
    from orthonav.ground.recordings.setups import Counts

    counts, out = Counts.of(results), options.out
    exported = [Path(each.partition("=")[2]) for each in options.export]
    latencies = [each.latency_ms for each in results if math.isfinite(each.latency_ms)]
    median_ms = median(latencies) if latencies else None
    plain = {
        "fixes": None if out is None else str(out),
        "views": counts.views,
        "n_confident": counts.confident,
        "n_low_confidence": counts.low,
        "n_none": counts.none,
        "reasons": dict(counts.reasons),
        "accept": None if options.alert_limit_m else options.accept,
        "alert_limit_m": options.alert_limit_m,
        "risk": options.risk,
        "median_latency_ms": None if median_ms is None else round(median_ms, 3),
        "advice": list(advice),
        "setups": list(tried),
    }
    if out is None:
        plain["positions"] = [result.to_dict() for result in results]
    with beside(out, *exported):
        if options.json:
            print_json(plain)
            return
        others = "above the alert limit" if options.alert_limit_m else "of low confidence"
        fixes = [each.outcome for each in results if isinstance(each.outcome, orthonav.Fix)]
        infinite = sum(math.isinf(each.protection_level_m(accept.risk)) for each in fixes)
        doubt = f" ({infinite} infinite: place in doubt)" * bool(options.alert_limit_m)
        named = ", ".join(f"{reason} {count}" for reason, count in counts.reasons)
        why = f" ({named})" if named else ""
        print(
            f"{counted(counts.views, 'view')}: {counts.confident} confident ({accept.text()}), "
            f"{counts.low} {others}{doubt}, {counts.none} without a position{why}; "
            f"median {median_ms or 0:.1f} ms per view"
        )
        lines = [f"! {line}" for line in advice]
        lines += [f"{counted(counts.confident, 'camera position')}: {path}" for path in exported]
        if out is not None:
            where = "stdout" if is_stdout(out) else out
            guesses = f"; positions {others} are best guesses, marked as such"
            lines.append(f"written to {where}{guesses * bool(counts.low)}")
        for line in lines:
            print(line)


class SetupAdvice:
    """Views of low confidence of a run, from which its summary advises what to check."""

    def __init__(
        self,
        options: argparse.Namespace,
        flight: "Recording",
        localizer: "orthonav.Localizer",
        corrected: "Callable[[orthonav.Telemetry], orthonav.Telemetry]",
    ) -> None:
        from orthonav.ground.recordings.setups import LowConfidenceViews

        self._options, self._localizer = options, localizer
        self._low = LowConfidenceViews(flight.camera, corrected)
        self._distances: list[tuple[float, str]] = []
        self._yaw_deg: list[float] = []

    def take(self, view: "RecordedView", result: "orthonav.ViewResult") -> None:
        if (found := far_from_map(view, self._localizer)) is not None:
            self._distances.append(found)
        self._yaw_deg.append(view.telemetry.yaw_deg)
        self._low.take(view, result)

    def advice(
        self, results: "Sequence[orthonav.ViewResult]", accept: "Acceptance"
    ) -> "tuple[list[str], list[dict[str, Any]]]":
        """Sentences on what to check, and the configurations that were tried as JSON values.

        Both are empty where enough views are confident.
        """
        from orthonav.core.localize.confidence import Acceptance
        from orthonav.ground.recordings.setups import Counts

        if math.isfinite(accept.alert_limit_m):  # a high level is no sign of a wrong setup
            accept = Acceptance("confidence", orthonav.CONFIDENT)
            results = [accept.judged(each) for each in results]
        counts, known = Counts.of(results), self._options.heading == "known"
        lines = [RADIANS] if known and seem_radians(self._yaw_deg) else []
        if not counts.few:
            return lines, []
        nearest = min(self._distances, default=(0.0, ""))
        if nearest[0] > FAR_M:
            return [*lines, far_text("the recorded positions are", *nearest)], []
        if counts.low and not any(accept.knows(result.outcome) for result in results):
            silent = f"no fix states the criterion {accept.criterion}, so none can be confident; "
            silent += "build the map from a larger or more varied area, or give --accept "
            return [*lines, f"{silent}peak_ratio:1.3"], []
        if not self._low.views or self._options.quiet:
            return lines, []
        try:
            said, tried = self._tried(accept)
        except KeyboardInterrupt:  # skips the search; the results are written
            return [*lines, "the search for another configuration was interrupted"], []
        return lines + said, [
            {"setup": each.setup.name, "views": each.views, "confident": each.confident}
            for each in tried
        ]

    def _tried(self, accept: "Acceptance") -> "tuple[list[str], list[Tried]]":
        from orthonav.ground.recordings.setups import setup_text, try_setups

        reporter(self._options)(
            "few views are confident: trying other configurations on some of them for up to "
            f"{BUDGET_S:.0f} s (Ctrl-C or --quiet skips this)"
        )
        end_s = time.monotonic() + BUDGET_S
        tried = try_setups(
            self._localizer,
            self._low.views,
            accept.accepts,
            use_prior=self._options.prior == "telemetry",
            heading_known=self._options.heading == "known",
            tracked=bool(self._options.track or self._options.smooth),
            stop=lambda: time.monotonic() > end_s,
        )
        late = f"the search for another configuration was ended after {BUDGET_S:.0f} s"
        lines = [late] if time.monotonic() > end_s else []
        return lines + (setup_text(tried, on_map=bool(self._distances)) if tried else []), tried


def _take_flown(options: argparse.Namespace, flight: "Recording") -> "Mount | None":
    """Mount to use; with `--as-flown`, the logged options replace those of `options`.

    Logs a warning where options or the map differ from those of the flight. Raises `FlightError`
    for invalid logged options.
    """
    from orthonav.core.flight.mount import read_mount
    from orthonav.core.mapfile.reader import map_digest
    from orthonav.ground.recordings import LoggedFlight
    from orthonav.ground.recordings.flightlog import LOCALIZE_CHOICES, logged_options

    mount: Mount | None = read_mount(options.mount) if options.mount else None
    if not isinstance(flight, LoggedFlight):
        if options.as_flown:
            raise UsageError(f"--as-flown needs a flight log: {flight.path}")
        return mount
    logged = flight.session.get("map")
    logged = logged if isinstance(logged, dict) else {}
    if logged.get("manifest_sha256") not in (None, map_digest(options.map)):
        name = logged.get("name")
        log.warning("the log was flown with another map (%.80s): %s", name, options.map)
    flown = logged_options(flight.session.get("options"))
    if options.as_flown:
        for name in (*LOCALIZE_CHOICES, "track", "alert_limit_m", "risk"):
            setattr(options, name, flown.get(name, getattr(options, name)))
        options.accept = flown.get("accept") or options.accept
        options.skip_bad_images = True  # a flight continues after an image that cannot be decoded
        return flown.get("mount", mount)
    chosen = vars(options) | {"track": options.track or options.smooth, "mount": mount}
    # The runner logs every fix without --accept, so the default applies.
    differ = [
        name
        for name, value in flown.items()
        if value != chosen[name] and (name, value) != ("accept", None)
    ]
    if differ:
        log.warning(
            "options differ from those of the flight (%s); --as-flown uses the logged ones",
            ", ".join(differ),
        )
    return mount


def _check_destination(options: argparse.Namespace) -> None:
    """Raise `UsageError` where positions have no place to go, or share it with the summary."""
    from orthonav.ground.recordings.photos import is_photo

    if options.out is not None and is_stdout(options.out) and options.json:
        raise UsageError("--out - and --json both write to stdout: give one of them")
    if options.out is None:
        named = [path for path in options.flight if not path.is_file() or not is_photo(path)]
        if named and all(path.exists() for path in named):
            raise UsageError("give --out FILE, or --out - for stdout")


def _write_positions(
    options: argparse.Namespace, results: "Sequence[orthonav.ViewResult]", identity: "Identity"
) -> None:
    """Write one line of JSON per view to the file or to stdout, or print them for people."""
    from orthonav.core.flight.fixes import write_results

    if options.out is not None:
        write_results(options.out, results, identity)
    elif not options.json:
        for result in results:
            print(_position_text(result, options.alert_limit_m))


def _position_text(result: "orthonav.ViewResult", alert_limit_m: float | None) -> str:
    outcome = result.outcome
    if isinstance(outcome, orthonav.Fix):
        lines = _lines(outcome, result, alert_limit_m)
    else:
        hints = {
            "yaw_deg": "give --heading unknown",
            "agl_m": "give --agl-m",
            "pitch_deg": "give --looks-down",
        }
        advice = "".join(f"; {hint}" for name, hint in hints.items() if name in outcome.detail)
        lines = {"position": f"none: {outcome.detail} ({outcome.reason}){advice}"}
    return "\n".join([result.frame, *(f"  {name:<11}{text}" for name, text in lines.items())])


def _lines(
    fix: "orthonav.Fix", result: "orthonav.ViewResult", alert_limit_m: float | None
) -> dict[str, str]:
    east_m, north_m = (math.sqrt(float(fix.cov_en_m2[i, i])) for i in (0, 1))
    level_m = fix.protection_level_m(result.risk)
    level = f"{level_m:.0f} m"
    protection = f"{level}, which the error exceeds with a probability of at most {result.risk:g}"
    if math.isinf(level_m):
        level = "infinite"
        protection = "none: the place itself may be wrong with a probability above "
        protection += f"{result.risk:g}; more views of a flight (--track) confirm it"
    low = "low confidence"
    if alert_limit_m is not None:
        low = f"protection level {level}, at most {alert_limit_m:g} m is allowed"
    judged = "confident" if result.is_confident else f"{low}: this is a best guess"
    if math.isfinite(fix.confidence):
        judged = f"{fix.confidence:.2f} that the error is below {fix.radius_m:.0f} m ({judged})"
    return {
        "position": f"{fix.lat_deg:.7f}, {fix.lon_deg:.7f} (latitude, longitude, WGS 84)",
        "deviation": f"{east_m:.1f} m east, {north_m:.1f} m north (1 sigma)",
        "confidence": judged,
        "protection": protection,
        "heading": f"{fix.heading_deg:.1f} deg from true north, of the top of the image",
        "height": f"{fix.agl_m:.1f} m above ground",
    }
