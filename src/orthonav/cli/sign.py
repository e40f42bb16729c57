"""`orthonav sign`: sign a map, or create a signing key."""

import argparse
from pathlib import Path

from orthonav.core.errors import UsageError

EXAMPLE = "area.onav --key keys/private.pem"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("map", type=Path, metavar="MAP.onav", nargs="?", help="map to sign")
    how = parser.add_mutually_exclusive_group(required=True)
    how.add_argument("--key", type=Path, metavar="KEY.pem", help="Ed25519 private key (PEM)")
    text = "create private.pem and public.pem in this folder, and sign the map if one is given"
    how.add_argument("--new-key", type=Path, metavar="DIR", help=text)
    text = "serial number in the signature (default: seconds since 1970, which increase)"
    parser.add_argument("--serial", type=int, help=text)


def run(options: argparse.Namespace) -> None:
    from orthonav.core.mapfile.signature import PRIVATE_NAME, PUBLIC_NAME, new_key, sign_map

    key = options.key
    if options.new_key is not None:
        made = new_key(options.new_key)
        key, public = options.new_key / PRIVATE_NAME, options.new_key / PUBLIC_NAME
        print(f"key {made}: keep {key} secret, give {public} to those who fly")
    if options.map is not None:
        print(f"written to {sign_map(options.map, key, options.serial)}")
    elif options.key is not None:
        raise UsageError("--key needs a map to sign: orthonav sign MAP.onav --key private.pem")
