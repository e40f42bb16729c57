"""`orthonav verify`: check a map and its signature."""

import argparse
from pathlib import Path


def add(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("map", type=Path, metavar="MAP.onav")
    parser.add_argument(
        "--public-key",
        type=Path,
        required=True,
        metavar="public.pem",
        help="Ed25519 public key (PEM) of whoever must have signed it",
    )


def run(options: argparse.Namespace) -> None:
    """Check the signature, then every part; an error where either does not hold."""
    from orthonav.mapfile import open_map
    from orthonav.mapfile.signature import require_signature

    digest = require_signature(options.map, options.public_key)
    open_map(options.map)
    print(f"signed and whole: {options.map}\nmanifest  {digest}")
