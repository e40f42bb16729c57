"""Shared by several commands: options, what they ask for, progress bars, JSON output."""

import argparse
import io
import json
import logging
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext, redirect_stdout
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from tqdm import tqdm

from orthonav.core.errors import UsageError
from orthonav.core.files import is_stdout
from orthonav.core.limits import ALERT_LIMITS_M, DEFAULT_RISK, RISKS
from orthonav.ground import planning

if TYPE_CHECKING:
    from orthonav.core.geo.camera import Camera
    from orthonav.core.localize.confidence import Acceptance
    from orthonav.core.localize.plan import SearchPlan
    from orthonav.core.mapfile.signature import Signature

T = TypeVar("T")
log = logging.getLogger(__name__)


def numbers(count: int, expected: str) -> Callable[[str], tuple[float, ...]]:
    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) != count:
            raise argparse.ArgumentTypeError(f"expected {expected}, got '{text}'")
        return values

    return parse


def within(least: float, most: float, kind: type = float) -> Callable[[str], float]:
    def number(text: str) -> float:
        try:
            value: float = kind(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"expected {least:g} to {most:g}, got '{text}'")
        return value

    return number


def _bands(text: str) -> tuple[int, ...]:
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise argparse.ArgumentTypeError(f"expected numbers from 1, such as 1,2,3, got '{text}'")
    return tuple(map(int, parts))


FLAG: dict[str, Any] = {"action": "store_true"}
NUMBER: dict[str, Any] = {"type": float}
WHOLE: dict[str, Any] = {"type": int}
FILE: dict[str, Any] = {"type": Path, "metavar": "FILE"}


def _option(kind: Mapping[str, Any], text: str) -> dict[str, Any]:
    return {**kind, "help": text}


OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "--accept": _option(
        {"default": "confidence:0.9", "metavar": "NAME:MIN"},
        "criterion of a confident fix and its threshold: confidence:0.9 (default) or "
        "peak_ratio:1.3",
    ),
    "--alert-limit-m": _option(
        {"type": within(*ALERT_LIMITS_M), "metavar": "M"},
        "largest horizontal error that the mission allows: a fix is confident if its "
        "protection level is at most that (replaces --accept)",
    ),
    "--agl-m": _option(NUMBER, "height above ground"),
    "--allow-holes": _option(FLAG, "write the file even if imagery is missing"),
    "--band-m": _option(NUMBER, "width of the search band for legs without a width of their own"),
    "--bounds": _option(
        {"type": numbers(4, "W,S,E,N in degrees"), "metavar": "W,S,E,N"},
        "area: west, south, east, north in degrees",
    ),
    "--budget-ms": _option(
        {"type": within(0.001, 1e9), "default": math.inf, "metavar": "MS"},
        "time limit per view (default: none); a search that would exceed it is not "
        "started, and the result is the best position so far",
    ),
    "--camera": _option(FILE, "camera file: flight.json, or of OpenCV, ROS or Kalibr"),
    "--bands": _option(
        {"type": _bands, "metavar": "N[,N,N]"},
        "bands of the files, one or three, from 1: 4 is often near infrared (default: red, "
        "green and blue, or the first)",
    ),
    "--mask": _option(
        {"type": Path, "metavar": "PNG"},
        "grey image of the size of the camera's, black where the picture never shows "
        "ground: landing gear, propellers, text",
    ),
    "--dem": _option(FILE, "terrain model (any raster that GDAL reads) for heights above ground"),
    "--surface": _option(
        FILE | {"action": "append", "default": []},
        "surface model with houses and trees (any raster that GDAL reads), which stand on "
        "the terrain of --dem or on its own lower envelope; may be repeated",
    ),
    "--true-ortho": _option(
        FLAG,
        "houses stand upright in the orthophotos (true orthophotos): no lean is estimated "
        "from --surface",
    ),
    "--dem-datum": _option(
        {"metavar": "NAME"},
        "vertical datum of a terrain or surface file that does not state it: egm96, egm2008, "
        "msl, ellipsoid or EPSG:NUMBER of a vertical system",
    ),
    "--relief": _option(
        {"choices": ("level", "rolling", "hills")},
        "what the land is like where no terrain is given: slopes of 1, 5 (default) or "
        "12 %% RMS, which look like tilt of the camera",
    ),
    "--gsd-m": _option(
        NUMBER, "ground resolution, metres per pixel (default: suited to imagery or view)"
    ),
    "--heading": _option(
        {"choices": ("known", "unknown"), "default": "known"},
        "known: from telemetry (default); unknown: all headings are tried",
    ),
    "--json": _option(FLAG, "print as JSON"),
    "--mount": _option(
        {"type": Path, "metavar": "mount.json"},
        "calibration by `orthonav calibrate`, which corrects heading, height, pitch and "
        "roll; without it the mount counts as known to 2.5 deg",
    ),
    "--mount-deg": _option(
        NUMBER | {"nargs": 3, "default": (0.0, 0.0, 0.0), "metavar": ("YAW", "PITCH", "ROLL")},
        "orientation of the camera in the aircraft; 0 0 0 (default) looks straight down "
        "with the top of the image forward",
    ),
    "--not-before": _option(
        {"metavar": "DATE|SERIAL"},
        "refuse a map signed before this date (2026-05-31, UTC) or with a lower serial number",
    ),
    "--ortho": _option(
        FILE | {"action": "extend", "nargs": "+", "required": True},
        "orthophoto (any georeferenced raster that GDAL reads), or a folder of them, "
        "where newer files take precedence; may be repeated, earlier ones take precedence",
    ),
    "--overlap": _option(
        NUMBER | {"metavar": "FRACTION"},
        "overlap of neighbouring tiles, as a fraction of their width (default 0.875)",
    ),
    "--prior": _option(
        {"choices": ("telemetry", "none"), "default": "telemetry"},
        "telemetry: search around the prior position, if any (default); none: search the whole map",
    ),
    "--radius-m": _option(
        NUMBER | {"default": 15.0}, "largest error of a correct fix (default 15)"
    ),
    "--require-signed": _option(
        {"type": Path, "metavar": "public.pem"},
        "refuse a map that was not signed with this key (see `orthonav sign`)",
    ),
    "--risk": _option(
        {"type": within(*RISKS), "default": DEFAULT_RISK, "metavar": "P"},
        f"probability with which the error exceeds the protection level (default {DEFAULT_RISK:g})",
    ),
    "--route": _option(
        FILE,
        "planned route: GeoJSON, CSV, KML or KMZ, GPX, WPML, a QGroundControl plan "
        "or a waypoint file (FILE#NAME or FILE#NUMBER selects one of several)",
    ),
    "--seed": _option(WHOLE, "seed of all random draws"),
    "--speed-mps": _option(NUMBER, "ground speed"),
    "--threads": _option(
        {"type": within(1, 64, int), "default": 1, "metavar": "N"},
        "threads that search for one view (default 1); positions do not depend on them",
    ),
    "--tile-px": _option(WHOLE, "width of a tile (default 256, or suited to the view)"),
    "--workers": _option(WHOLE, "number of parallel workers (default: one per core)"),
}
"""Options of several commands, with what `argparse` needs to know."""


def add_options(group: argparse._ActionsContainer, *names: str, **changes: Any) -> None:
    """Add shared options; `changes` replace what `OPTIONS` says of each."""
    for name in names:
        group.add_argument(name, **{**OPTIONS[name], **changes})


def add_area(parser: argparse._ActionsContainer, *, required: bool = False) -> None:
    where = parser.add_mutually_exclusive_group(required=required)
    add_options(where, "--route", "--bounds")
    add_options(parser, "--band-m")


def area_of(options: argparse.Namespace) -> "planning.Area":
    """The area that the options of `add_area` name; raises `AreaError`, `RouteError` or
    `UsageError`."""
    if options.route is None and options.bounds is None:
        raise UsageError("give one area: --route FILE, or --bounds W,S,E,N in degrees")
    if options.route is None:
        planning.require_one_area(None, options.band_m, options.bounds)
        return planning.Area.from_bounds(options.bounds)
    return planning.Area.from_route(planning.read_route(options.route), options.band_m)


def add_acceptance(parser: argparse._ActionsContainer, **accept: Any) -> None:
    """Add `--accept`, which `accept` changes, `--alert-limit-m` and `--risk`."""
    one = parser.add_mutually_exclusive_group()
    add_options(one, "--accept", **accept)
    add_options(one, "--alert-limit-m")
    add_options(parser, "--risk")


def acceptance(options: argparse.Namespace) -> "Acceptance":
    """The rule that the options of `add_acceptance` name; raises `VariantError`."""
    from orthonav.core.localize.confidence import ALERT_LIMIT, Acceptance

    if options.alert_limit_m is not None:
        return Acceptance(ALERT_LIMIT, options.alert_limit_m, options.risk)
    return Acceptance.parse(options.accept, options.risk)


def search_plan(options: argparse.Namespace) -> "SearchPlan":
    """The plan of the search with `--budget-ms` and `--threads`."""
    from orthonav.core.localize.plan import DEFAULT_PLAN

    return replace(DEFAULT_PLAN, budget_ms=options.budget_ms, threads=options.threads)


def checked_signature(options: argparse.Namespace) -> "Signature | None":
    """The signature of the map that `--require-signed` and `--not-before` ask for."""
    from orthonav.core.mapfile.signature import require_signature

    if options.require_signed is not None:
        return require_signature(options.map, options.require_signed, options.not_before)
    if options.not_before is not None:
        raise UsageError("--not-before needs --require-signed")
    return None


class Progress:
    """Progress bars by stage on a terminal; silent without a terminal or when quiet."""

    def __init__(self, quiet: bool) -> None:
        self._off = quiet or not sys.stderr.isatty()
        self._bar: Any = None
        self._stage = ""

    def __call__(self, stage: str, share: float) -> None:
        """Show `share` (0..1) of `stage` as done."""
        if self._off:
            return
        if stage != self._stage:
            self.close()
            self._stage = stage
            bar = "{desc:>10} {percentage:3.0f}%|{bar}| {remaining}"
            self._bar = tqdm(total=1000, desc=stage, delay=1, bar_format=bar)
        self._bar.update(round(share * 1000) - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def watched(items: Iterable[T], expected: int | None, stage: str, shown: Progress) -> Iterator[T]:
    """The same items; the share of those expected that were used is shown."""
    for number, item in enumerate(items, 1):
        yield item
        if expected:
            shown(stage, min(1.0, number / expected))


def progress(options: argparse.Namespace) -> AbstractContextManager[Progress]:
    """Progress bars of a command, closed on success and on errors."""
    return closing(Progress(options.quiet))


def reporter(options: argparse.Namespace) -> Callable[[str], None]:
    """Prints lines about the work to a person at a terminal, else logs them."""
    if options.quiet or not sys.stderr.isatty():
        return log.info
    return lambda line: print(line, file=sys.stderr)


@contextmanager
def beside(*outputs: Path | None) -> Iterator[None]:
    """What is printed goes to stderr where one of the outputs of a command is `-`, stdout."""
    taken = any(path is not None and is_stdout(path) for path in outputs)
    with redirect_stdout(sys.stderr) if taken else nullcontext():
        yield


def given(options: argparse.Namespace, record: type) -> dict[str, Any]:
    """The options that are fields of a record, without those that were not given."""
    named = {each.name: getattr(options, each.name, None) for each in fields(record)}
    return {name: value for name, value in named.items() if value is not None}


def say(options: argparse.Namespace, text: str) -> None:
    if not options.quiet:
        print(text, file=sys.stderr, flush=True)


def run_command(options: argparse.Namespace, *words: object, **values: Any) -> str:
    """What a command prints, as quiet as this one; `values` replace those of its options."""
    from orthonav import cli

    parsed = cli.parse([*map(str, words), *["--quiet"] * options.quiet])
    vars(parsed).update(values)
    with redirect_stdout(io.StringIO()) as printed:
        cli.module_of(parsed.command).run(parsed)
    return printed.getvalue()


def counted(number: int, noun: str) -> str:
    """A number and its noun: `1 view`, `2,000 views`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def camera_of(options: argparse.Namespace) -> "Camera":
    """The camera of `--camera`, else the usual one."""
    from orthonav.core.geo.camera import Camera

    own = options.camera
    return planning.DEFAULT_CAMERA if own is None else Camera.from_file(own)


def print_json(plain: Any) -> None:
    print(json.dumps(plain, indent=1, allow_nan=False))


def print_result(options: argparse.Namespace, plain: Any, *lines: str) -> None:
    """Print plain values with `--json`, else lines for people."""
    if options.json:
        print_json(plain)
    else:
        print(*lines, sep="\n")
