"""`python -m benchmarks.training`: time of a training step of the auto-encoder, option by option.

Each row adds one option to the row above, in a process of its own, on the model that
`orthonav build --method autoencoder` trains: 256 px edge maps, 32 a batch. The losses of a smaller
model, trained plainly and with all options, show that the result stays the same. The last table
gives size, time and accuracy of an encoder of width 32 in each precision.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.child import peak_memory_mb
from benchmarks.record import Section, Table, number, provenance, save

PLAIN = {"bf16": False, "fused": False, "keep_memory": False}
MEANS: dict[str, dict[str, bool]] = {
    "plain float32": PLAIN,
    "+ fused optimizer": {**PLAIN, "fused": True},
    "+ freed memory reused": {**PLAIN, "fused": True, "keep_memory": True},
    "+ bfloat16": {"bf16": True, "fused": True, "keep_memory": True},
}
WHOLE = "+ bfloat16"
LOSSES = "losses"
PRECISIONS = "precisions"
PARTS = (*MEANS, LOSSES, PRECISIONS)
SEEDS = (0, 1, 2)
CURVE = {"tile_px": 64, "width": 32, "dims": 128, "epochs": 60}
"""A smaller model, for which plain training takes seconds."""
TILE_PX, BATCH = 256, 32


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write; returns the exit code."""
    options = _parser().parse_args(arguments)
    if options.child:
        print(json.dumps(_learn(**json.loads(options.child))))
        return 0
    start = time.perf_counter()
    started = provenance("training")
    wanted = options.only or PARTS
    section = Section("Training the auto-encoder")
    rows = [name for name in wanted if name in MEANS]
    if rows:
        section.tables.append(_speed(section, rows, options.steps))
    if LOSSES in wanted:
        section.tables.append(_curves(section))
    if PRECISIONS in wanted:
        section.tables.append(_precisions(section))
    print(section.markdown(), flush=True)
    # The suite keeps the facts of its last section.
    wall_s = time.perf_counter() - start
    for path in save(options.out, [section], started, wall_s=wall_s, latest=False):
        print(path, file=sys.stderr)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.training", description=str(__doc__).splitlines()[0]
    )
    parser.add_argument("--steps", type=int, default=5, help="timed steps per row")
    parser.add_argument("--only", nargs="+", choices=PARTS, help="only these rows")
    parser.add_argument(
        "--out", type=Path, default=Path("bench_results"), help="folder (default bench_results)"
    )
    parser.add_argument("--child", help=argparse.SUPPRESS)
    return parser


def _speed(section: Section, names: Sequence[str], steps: int) -> Table:
    """Time of a step with each means added."""
    rows, first_s, threads = [], None, 0
    for name in names:
        result = _in_a_process(means=MEANS[name], epochs=steps + 1, seed=0)
        timing = section.add(name, "s", result["seconds"][1:], data="generated edges", seed=0)
        first_s, threads = first_s or timing.median, result["threads"]
        cells = [number(value) for value in (timing.median, timing.p10, timing.p90)]
        gain = first_s / timing.median
        section.facts[f"gain {name}"] = gain
        first_step = number(result["seconds"][0])
        rows.append([name, *cells, number(gain), first_step, number(result["peak_mb"])])
    header = ("means", "step s", "p10", "p90", "times faster", "first step s", "peak MB")
    notes = (
        f"{threads} threads; {result['parameters']:,} parameters, {TILE_PX} px, batch {BATCH}; a "
        f"step reads tiles, forward, backward, optimizer; {steps} steps after the first one",
    )
    return Table("One step of learning", header, rows, notes)


def _curves(section: Section) -> Table:
    """Losses of the smaller model, plain and with all means, from the same first weights."""
    rows = []
    for name in ("plain float32", WHOLE):
        result = [
            _in_a_process(means=MEANS[name], seed=seed, count=8 * BATCH, **CURVE) for seed in SEEDS
        ]
        curves = np.array([one["losses"] for one in result])
        shown = [curves[:, at - 1] for at in (1, 10, 30, CURVE["epochs"])]
        section.add(f"last loss, {name}", "1", shown[-1], data="generated edges", seed=SEEDS[0])
        rows.append([name, *(" ".join(number(loss) for loss in losses) for losses in shown)])
    header = ("means", "epoch 1", "epoch 10", "epoch 30", f"epoch {CURVE['epochs']}")
    notes = (
        f"mean squared error of seeds {', '.join(map(str, SEEDS))}; {8 * BATCH} tiles of "
        f"{CURVE['tile_px']} px, width {CURVE['width']}, {CURVE['dims']} numbers",
    )
    return Table("Losses with and without", header, rows, notes)


def _precisions(section: Section) -> Table:
    """What flies of a smaller encoder in each precision: size, time of a tile, likeness."""
    result = _in_a_process(
        means=MEANS[WHOLE], epochs=10, seed=0, count=6 * BATCH, width=32, exported=True
    )
    rows = []
    for name, one in result["exported"].items():
        time_ms = section.add(f"a tile, {name}", "ms", one["ms"], data="generated edges", seed=0)
        cells = [number(value) for value in (one["mb"], time_ms.median, time_ms.p10, time_ms.p90)]
        rows.append([name, *cells, f"{one['mean']:.5f}", f"{one['least']:.5f}"])
    header = ("precision", "MB", "tile ms", "p10", "p90", "mean cosine", "least cosine")
    notes = (
        f"{TILE_PX} px, width 32, 1024 numbers, learnt for 60 steps; onnxruntime, one thread, "
        "processor time, one tile at a time; cosine to float32's embeddings of 32 other tiles",
    )
    return Table("Precisions of what flies", header, rows, notes)


def _in_a_process(**wanted: Any) -> dict[str, Any]:
    """Result of `_learn` in a fresh process."""
    # Benchmarks that import NumPy first may be held to one thread; learning uses what there is.
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {name: value for name, value in os.environ.items() if name not in names}
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.training", "--child", json.dumps(wanted)],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    )
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def _learn(
    means: dict[str, Any],
    epochs: int,
    seed: int,
    count: int = BATCH,
    tile_px: int = TILE_PX,
    width: int = 512,
    dims: int = 1024,
    exported: bool = False,
) -> dict[str, Any]:
    """Learn on `count` generated tiles; seconds and loss of each epoch, threads, peak memory."""
    import torch

    from orthonav.core.tiles.network import AutoEncoderRecipe
    from orthonav.research.autoencoder import Reconstruction
    from orthonav.research.means import Means, World, kept_memory
    from orthonav.research.training import train

    recipe = AutoEncoderRecipe(dims=dims, width=width, epochs=epochs, batch=BATCH)
    tiles = _edge_tiles(count, tile_px)
    how = dataclasses.replace(Means(device="cpu", workers=1), **means)
    marks = []
    with kept_memory(how.keep_memory):
        torch.manual_seed(seed)
        task = Reconstruction(recipe, tiles, binary=True)
        marks.append(time.perf_counter())
        losses = train(
            task,
            recipe,
            tiles,
            seed=seed,
            work=None,
            report=lambda text, share: marks.append(time.perf_counter()),
            means=how,
            world=World(),
        )
    return {
        "seconds": np.diff(marks).tolist(),
        "losses": losses,
        "threads": torch.get_num_threads(),
        "peak_mb": peak_memory_mb(),
        "parameters": sum(values.numel() for values in task.model.parameters()),
        "exported": _exported(task.encoder, recipe, tiles) if exported else {},
    }


def _exported(encoder: Any, recipe: Any, tiles: Any) -> dict[str, dict[str, Any]]:
    """Megabytes, milliseconds of single tiles and likeness of the encoder in each precision."""
    from orthonav.core.tiles.network import PRECISIONS as NAMES
    from orthonav.research.export import cosines, export_encoder

    held_out = _edge_tiles(32, TILE_PX, seed=1).batch(np.arange(32))
    calibration = tiles.batch(np.arange(64))
    wanted = export_encoder(encoder, recipe, calibration, held_out).embedder.views(held_out)
    result = {}
    for name in NAMES:
        flown = dataclasses.replace(recipe, precision=name)
        made = export_encoder(encoder, flown, calibration, held_out, least_cosine=-1.0).embedder
        alike = cosines(made.views(held_out), wanted)
        times_ms = []
        for at in list(range(32)) * 3:
            start = time.thread_time()
            made.views(held_out[at : at + 1])
            times_ms.append(1e3 * (time.thread_time() - start))
        result[name] = {
            "mb": made.onnx.nbytes / 1e6,
            "ms": times_ms,
            "mean": float(alike.mean()),
            "least": float(alike.min()),
        }
    return result


def _edge_tiles(count: int, tile_px: int, seed: int = 0) -> Any:
    """Tiles (binary edges) of a generated sheet with detail of several sizes."""
    import cv2

    from orthonav.research.tiles import SheetTiles

    rng = np.random.default_rng(seed)
    side = 4 * tile_px
    grey = np.zeros((side, side), np.float32)
    for sigma in (2.0, 6.0, 18.0):
        blots = cv2.GaussianBlur(rng.normal(size=grey.shape).astype(np.float32), (0, 0), sigma)
        grey += blots / blots.std()
    levels = np.clip(128 + 35 * grey, 0, 255).astype(np.uint8)
    edges = (np.asarray(cv2.Canny(levels, 100, 200)) > 0).astype(np.uint8)
    tiles_px = rng.integers(0, side - tile_px, (count, 2))
    return SheetTiles(edges[None], np.ones(edges.shape, bool), tiles_px, tile_px, scale=1.0)


if __name__ == "__main__":
    sys.exit(main())
