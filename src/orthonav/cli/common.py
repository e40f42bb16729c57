"""Shared by several commands: argument types, progress bars, JSON output."""

import argparse
import json
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

if TYPE_CHECKING:
    from orthonav.core.localize.policy import SearchPlan

MAX_THREADS = 64

ROUTE_HELP = (
    "planned route: GeoJSON, CSV, KML or KMZ, GPX, a QGroundControl plan or a waypoint "
    "file (FILE#NAME or FILE#NUMBER selects one of several)"
)


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
            self._bar = tqdm(
                total=1000,
                desc=stage,
                delay=1,
                bar_format="{desc:>10} {percentage:3.0f}%|{bar}| {remaining}",
            )
        self._bar.update(round(share * 1000) - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


@contextmanager
def progress(options: argparse.Namespace) -> Iterator[Progress]:
    """Progress bars of a command, closed on success and on errors."""
    shown = Progress(options.quiet)
    try:
        yield shown
    finally:
        shown.close()


def bounds(text: str) -> tuple[float, float, float, float]:
    """West, south, east, north in degrees, from `W,S,E,N`."""
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"expected W,S,E,N in degrees, got '{text}'") from error
    return west, south, east, north


def add_area(
    parser: argparse._ActionsContainer, group: argparse._ActionsContainer, band: str = ""
) -> None:
    """Add `--route` and `--bounds` to a group (or the parser), and `--band-m` to the parser, with
    its default `band` as text."""
    group.add_argument("--route", type=Path, metavar="FILE", help=ROUTE_HELP)
    group.add_argument(
        "--bounds",
        type=bounds,
        metavar="W,S,E,N",
        help="area: west, south, east, north in degrees; write --bounds=W,S,E,N if W is negative",
    )
    parser.add_argument(
        "--band-m",
        type=float,
        help=f"width of the search band for legs without a width of their own{band}",
    )


def add_dem(parser: argparse._ActionsContainer, effect: str) -> None:
    parser.add_argument(
        "--dem",
        type=Path,
        metavar="FILE",
        help=f"terrain model (any raster that GDAL reads), {effect}",
    )
    parser.add_argument(
        "--dem-datum",
        metavar="NAME",
        help="vertical datum of the terrain model, where the file does not state it: egm96, "
        "egm2008, msl, ellipsoid or EPSG:NUMBER of a vertical system",
    )


def add_search(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--budget-ms",
        type=float,
        metavar="MS",
        help="time limit per view (default: none); a search that would exceed it is not started, "
        "and the result is the best position so far",
    )
    parser.add_argument(
        "--threads",
        type=int,
        default=1,
        metavar="N",
        help="threads that search for one view (default 1); positions do not depend on them",
    )


def search_plan(options: argparse.Namespace) -> "SearchPlan":
    """The plan of the search with `--budget-ms` and `--threads`; raises `VariantError`."""
    from orthonav.core.errors import VariantError
    from orthonav.core.localize.policy import DEFAULT_PLAN

    budget_ms = math.inf if options.budget_ms is None else options.budget_ms
    if not budget_ms > 0:
        raise VariantError(f"--budget-ms must be above 0, got {budget_ms:g}")
    if not 1 <= options.threads <= MAX_THREADS:
        raise VariantError(f"--threads must be 1 to {MAX_THREADS}, got {options.threads}")
    return replace(DEFAULT_PLAN, budget_ms=budget_ms, threads=options.threads)


@contextmanager
def beside(*outputs: Path | None) -> Iterator[None]:
    """What is printed goes to stderr where one of the outputs of a command is `-`, stdout."""
    from orthonav.core.files import is_stdout

    taken = any(path is not None and is_stdout(path) for path in outputs)
    with redirect_stdout(sys.stderr) if taken else nullcontext():
        yield


def counted(number: int, noun: str) -> str:
    """A number and its noun: `1 view`, `2,000 views`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def print_json(plain: Any) -> None:
    print(json.dumps(plain, indent=1, allow_nan=False))


def add_orthos(parser: argparse._ActionsContainer, what: str) -> None:
    """Add `--ortho FILE|FOLDER ...`, which may be repeated."""
    parser.add_argument(
        "--ortho",
        action="extend",
        nargs="+",
        required=True,
        type=Path,
        metavar="FILE",
        help=f"{what}, or a folder of them, where newer files take precedence; may be repeated, "
        "earlier ones take precedence",
    )
