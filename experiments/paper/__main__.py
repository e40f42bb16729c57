"""`python -m experiments.paper`: run the paper's experiments; `report`: tables and plots of them.

Every run leaves one file under `paper_results/<setting>/` and is not run again while it is there.
"""

import argparse
import logging
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
PARTS = ("A", "B", "C", "D", "real", "own", "baselines")
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def main(arguments: list[str]) -> int:
    """Run what is asked for, then report; returns the exit code."""
    options = _parser().parse_args(arguments)
    for name in THREADS:  # NumPy's BLAS reads it once; PyTorch is told below
        os.environ.setdefault(name, "1")
    logging.basicConfig(level=logging.ERROR, format="%(levelname)s: %(message)s")
    from experiments.paper.tables import report

    if options.what == "run":
        _run(options, " ".join(["python -m experiments.paper", *arguments]))
    made = report(options.out, options.setting)
    if made is None:
        _say(f"nothing to report: no results in {options.out / options.setting}")
        return 1
    print(made.read_text(encoding="utf-8"))
    _say(f"written to {made.parent}")
    return 0


def _run(options: argparse.Namespace, command: str) -> None:
    import cv2

    from experiments.paper import baselines, runs
    from experiments.paper.methods import methods
    from experiments.paper.trajectories import SETTINGS

    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    _use_cores()
    start = time.perf_counter()
    place = runs.Workplace(options.out, SETTINGS[options.setting], command)
    wanted = set(options.only or PARTS)
    for scene in _scenes(options, wanted):
        for method in methods(place.setting, scene.trajectory.tiles, options.sam):
            if options.methods and method.family not in options.methods:
                continue
            made = runs.run(place, scene, method)
            minutes = (time.perf_counter() - start) / 60
            _say(f"{minutes:5.1f} min  {scene.name} {method.key}: {made['minutes']} min")
        based = place.work(scene, baselines.MAP_OF) / "map.onav"
        if scene.name == baselines.TRIED_ON and "baselines" in wanted and based.is_file():
            baselines.run(place, scene)


def _scenes(options: argparse.Namespace, wanted: set[str]) -> Iterator[Any]:
    from experiments.paper import scenes
    from experiments.paper.trajectories import SETTINGS

    setting = SETTINGS[options.setting]
    for name in ("B", "D", "A", "C"):
        if name in wanted or (name == "B" and "baselines" in wanted):
            yield scenes.generated(setting, name, options.out / "areas")
    if "own" in wanted and options.past and options.present:
        name = f"own-{options.past.stem}-{options.present.stem}"
        yield scenes.over(name, options.past, options.present, options.gsd_m)
    if "real" in wanted:
        found = list(scenes.real(options.data))
        if not found:
            _say("real imagery skipped: the optional real imagery beside the checkout is absent")
        yield from found


def _use_cores() -> None:
    """PyTorch may use every core that this process may run on; the rest of it one."""
    try:
        import torch
    except ImportError:
        return
    torch.set_num_threads(len(os.sched_getaffinity(0)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m experiments.paper", description=__doc__)
    parser.add_argument("what", nargs="?", choices=("run", "report"), default="run")
    parser.add_argument("--setting", choices=("reduced", "full"), default="reduced")
    parser.add_argument("--only", nargs="+", choices=PARTS, help="only these parts")
    parser.add_argument(
        "--methods", nargs="+", metavar="NAME", help="gradient, bovw, autoencoder, triplet"
    )
    parser.add_argument("--out", type=Path, default=Path("paper_results"), metavar="DIR")
    parser.add_argument(
        "--data", type=Path, default=DATA, metavar="DIR", help="optional real imagery"
    )
    parser.add_argument("--past", type=Path, help="an orthophoto of your own, for the map")
    parser.add_argument("--present", type=Path, help="the same ground at another date")
    parser.add_argument(
        "--gsd-m", type=float, help="ground resolution for --past (default its own)"
    )
    parser.add_argument("--sam", metavar="PATH", help="weights of Segment Anything: adds its rows")
    return parser


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
