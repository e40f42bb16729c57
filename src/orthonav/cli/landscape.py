"""`orthonav landscape`: generate orthophotos of one area at three dates."""

import argparse
from pathlib import Path

from orthonav.cli.common import print_json, progress


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the GeoTIFF files"
    )
    parser.add_argument(
        "--size-m",
        type=float,
        nargs=2,
        default=(2000.0, 2000.0),
        metavar=("EAST", "NORTH"),
        help="extent of the area (default 2000 2000)",
    )
    parser.add_argument(
        "--gsd-m", type=float, default=1.0, help="ground resolution, metres per pixel (default 1)"
    )
    parser.add_argument(
        "--hills",
        type=float,
        metavar="SLOPE",
        help="also write the terrain dem.tif, hills of this root mean square slope (0.15), "
        "and for each date the surface model *_dsm.tif with its buildings and trees",
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the landscape (default 1)")
    parser.add_argument("--json", action="store_true", help="print the file names as JSON")


def run(options: argparse.Namespace) -> None:
    """Generate the files and print their names."""
    from orthonav.ground.simulate.landscape import generate_area, generate_heights

    with progress(options) as shown:
        heights = []
        if options.hills is not None:  # first, so that an impossible slope is refused at once
            heights = generate_heights(
                options.out,
                slope=options.hills,
                size_m=tuple(options.size_m),
                gsd_m=options.gsd_m,
                seed=options.seed,
                progress=lambda share: shown("heights", share),
            )
        files = generate_area(
            options.out,
            size_m=tuple(options.size_m),
            gsd_m=options.gsd_m,
            seed=options.seed,
            progress=lambda share: shown("landscape", share),
        )
        files += heights
    if options.json:
        print_json({"files": [str(path) for path in files]})
    else:
        print("\n".join(str(path) for path in files))
