"""`--require-signed` and `--not-before`, as in `localize` and `fly`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from orthonav.core.errors import VariantError

if TYPE_CHECKING:
    from orthonav.core.mapfile.signature import Signature


def add_signature(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--require-signed",
        type=Path,
        metavar="public.pem",
        help="refuse a map that was not signed with this key (see `orthonav sign`)",
    )
    group.add_argument(
        "--not-before",
        metavar="DATE|SERIAL",
        help="with --require-signed: refuse a map signed before this date (2026-05-31, UTC) or "
        "with a lower serial number",
    )


def checked_signature(options: argparse.Namespace) -> "Signature | None":
    """None without `--require-signed`."""
    from orthonav.core.mapfile.signature import require_signature

    if options.require_signed is not None:
        return require_signature(options.map, options.require_signed, options.not_before)
    if options.not_before is not None:
        raise VariantError("--not-before needs --require-signed")
    return None
