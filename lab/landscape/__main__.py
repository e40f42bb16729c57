"""Generate orthophotos of one area at several dates: `python -m lab.landscape --out area`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lab.landscape import DEFAULT_DATES, OTHER_LIGHT, generate_area, generate_heights
from orthonav.core.errors import OrthonavError


def main(arguments: Sequence[str]) -> None:
    """Generate the files and print their names."""
    options = _parser().parse_args(arguments)
    area = {"size_m": tuple(options.size_m), "gsd_m": options.gsd_m, "seed": options.seed}
    files: list[Path] = []
    try:
        if options.hills is not None:  # first, so that an impossible slope is refused at once
            files = generate_heights(options.out, slope=options.hills, **area)
        dates = DEFAULT_DATES + OTHER_LIGHT * options.other_light
        print(*generate_area(options.out, dates=dates, **area), *files, sep="\n")
    except OrthonavError as error:
        sys.exit(f"error: {error}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m lab.landscape", description=__doc__)
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="folder to write")
    add("--size-m", type=float, nargs=2, default=(2000.0, 2000.0), metavar=("EAST", "NORTH"))
    add("--gsd-m", type=float, default=1.0, help="metres per pixel (default 1)")
    add(
        "--hills",
        type=float,
        metavar="SLOPE",
        help="also write the terrain dem.tif, hills of this root mean square slope (0.15), "
        "and for each date the surface model *_dsm.tif with its buildings and trees",
    )
    add(
        "--other-light",
        action="store_true",
        help="also write the area under snow and flood, with bare trees, in near infrared, at "
        "night, and by a thermal camera",
    )
    add("--seed", type=int, default=1, help="seed of the landscape (default 1)")
    return parser


if __name__ == "__main__":
    main(sys.argv[1:])
