"""Share of views that find their tile, on optional real imagery beside the checkout.

`python -m benchmarks.real_imagery [--views 200] [--out FILE.md]` builds a map of the earlier date
of each pair, flies over the later ones at random places and prints a Markdown table. Maps and
flights go into a temporary folder. Parameters of the embedding were chosen on the Szada pairs and
on generated areas, with NAIP's figures in view: none of these is an unseen test.
"""

import argparse
import os
import subprocess
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np

from orthonav.evaluate.metrics import compare, measure
from orthonav.flight import open_flight, read_truth
from orthonav.localizer import Localizer
from orthonav.mapfile import open_map
from orthonav.onboard.run import localize_flight
from orthonav.prepare import BuildRequest, build_map
from orthonav.simulate.flight import Errors, SimulateRequest, simulate_flight

DATA = Path(os.environ.get("ORTHONAV_DATA", "../shared/data"))
PAIRS = {
    "naip_nd/20090818.tif": (
        "naip_nd/20120731.tif",
        "naip_nd/20150926.tif",
        "naip_nd/20180716.tif",
    ),
    "airchange/szada_1_a.tif": ("airchange/szada_1_b.tif",),
    "airchange/szada_5_a.tif": ("airchange/szada_5_b.tif",),
    "airchange/szada_7_a.tif": ("airchange/szada_7_b.tif",),
    "airchange/szada_mosaic_a.tif": ("airchange/szada_mosaic_b.tif",),
}
HEADER = (
    "| map | views of | tile spacing | within 0.75 of it | within 1 | "
    "confidence >= 0.9: kept, within 1 |",
    "|---|---|---|---|---|---|",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--yaw-std-deg", type=float, default=5.0)
    parser.add_argument("--agl-std", type=float, default=0.05)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    lines = list(HEADER)
    with tempfile.TemporaryDirectory() as folder:
        for reference, others in PAIRS.items():
            if not (DATA / reference).is_file():
                print(f"not there, left out: {DATA / reference}")
                continue
            map_path = Path(folder, "map.onav")
            build_map(BuildRequest([DATA / reference], map_path))
            for number, other in enumerate(others):
                flight = Path(folder, f"flight-{Path(reference).stem}-{number}")
                lines.append(_row(map_path, reference, other, flight, options))
                print(lines[-1], flush=True)
    command = "git rev-parse --short HEAD"
    commit = subprocess.run(command.split(), capture_output=True, text=True, check=False).stdout
    lines.append(
        f"\n{options.views} views each, heading off by {options.yaw_std_deg:g} deg and height by "
        f"{options.agl_std:.0%} (standard deviations), no prior, seed {options.seed}, commit "
        f"{commit.strip() or 'unknown'}: `python -m benchmarks.real_imagery`."
    )
    text = "\n".join(lines)
    print("\n" + text)
    if options.out:
        options.out.write_text(text + "\n", encoding="utf-8")


def _row(
    map_path: Path, reference: str, other: str, flight: Path, options: argparse.Namespace
) -> str:
    errors = Errors(yaw_std_deg=options.yaw_std_deg, agl_std=options.agl_std)
    simulate_flight(
        SimulateRequest(
            [DATA / other], flight, random=options.views, errors=errors, seed=options.seed
        )
    )
    localizer = Localizer(open_map(map_path))
    stride_m = localizer.grid.stride_m
    results = list(localize_flight(localizer, open_flight(flight), use_prior=False))
    comparison = compare(read_truth(flight / "truth.csv"), results)
    near = measure(comparison, 0.75 * stride_m)
    metrics = measure(comparison, stride_m)
    kept = [row for row in metrics.criteria if row.name == "confidence" and row.threshold == 0.9]
    share, right = kept[0].share_kept, kept[0].accuracy
    right_text = "-" if np.isnan(right) else f"{right:.1%}"
    return (
        f"| {Path(reference).stem} | {Path(other).stem} | {stride_m:g} m | {near.accuracy:.1%} | "
        f"{metrics.accuracy:.1%} | {share:.1%}, {right_text} |"
    )


if __name__ == "__main__":
    main()
