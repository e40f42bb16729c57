"""`orthonav landscape`: generate an area at several dates."""

import argparse
from pathlib import Path

from orthonav.cli.common import print_json, progress


def add(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument(
        "--size-m", type=float, nargs=2, default=(2000.0, 2000.0), metavar=("EAST", "NORTH")
    )
    parser.add_argument("--gsd-m", type=float, default=1.0, help="metres per pixel (default 1)")
    parser.add_argument("--seed", type=int, default=1, help="which landscape (default 1)")
    parser.add_argument("--json", action="store_true", help="print the files as JSON")


def run(options: argparse.Namespace) -> None:
    """Generate and name the files."""
    from orthonav.simulate.landscape import generate_area

    with progress(options) as shown:
        files = generate_area(
            options.out,
            size_m=tuple(options.size_m),
            gsd_m=options.gsd_m,
            seed=options.seed,
            progress=lambda share: shown("landscape", share),
        )
    if options.json:
        print_json({"files": [str(path) for path in files]})
    else:
        print("\n".join(str(path) for path in files))
