"""`orthonav verify`: check the signature and the contents of a map."""

import argparse
from pathlib import Path

from orthonav.cli.common import add_options

EXAMPLE = "area.onav --key keys/public.pem"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("map", type=Path, metavar="MAP.onav", help="map to check")
    text = "Ed25519 public key (PEM) of the expected signer"
    parser.add_argument("--key", type=Path, required=True, metavar="KEY.pem", help=text)
    add_options(parser, "--not-before")


def run(options: argparse.Namespace) -> None:
    from orthonav.core.mapfile import open_map
    from orthonav.core.mapfile.signature import require_signature

    found = require_signature(options.map, options.key, options.not_before)
    open_map(options.map, found.manifest_sha256)
    print(f"signature and contents are valid: {options.map}\nmanifest  {found.manifest_sha256}")
    print(f"serial    {found.serial}\nsigned    {found.signed_utc}")
