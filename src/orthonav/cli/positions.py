"""Where `localize` puts positions: a file, stdout, or the terminal for photographs."""

import argparse
import json
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from orthonav.core.flight.fixes import Identity
    from orthonav.core.records import Fix, ViewResult

_HINTS = (
    ("yaw_deg", "give --heading unknown"),
    ("agl_m", "give --agl-m"),
    ("pitch_deg", "give --looks-down"),
)
"""What to do about a value that is missing."""


def check_destination(options: argparse.Namespace) -> None:
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


def write_positions(
    options: argparse.Namespace, results: "Sequence[ViewResult]", identity: "Identity"
) -> None:
    """Write one line of JSON per view to the file or to stdout, or print them for people."""
    from orthonav.core.flight.fixes import write_results

    if options.out is not None:
        write_results(options.out, results, identity)
    elif not options.json:
        for result in results:
            print(position_text(result))


def positions_to_plain(
    options: argparse.Namespace, results: "Sequence[ViewResult]"
) -> dict[str, Any]:
    """The positions as JSON values, where they are written nowhere else."""
    from orthonav.core.flight.fixes import result_to_json

    if options.out is not None:
        return {}
    return {"positions": [json.loads(result_to_json(result)) for result in results]}


def position_text(result: "ViewResult") -> str:
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
