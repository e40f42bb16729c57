"""What a series of runs takes: steps of learning, disk and memory, said before it starts."""

import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.paper.methods import Method
from experiments.paper.scenes import Scene
from orthonav.core.tiles import embed
from orthonav.core.tiles.network import AutoEncoderRecipe, TripletRecipe
from orthonav.core.variants import make_variant
from orthonav.research.caevl_recipe import CaevlRecipe

STEP_MS = {"autoencoder": 15.0, "triplet": 250.0, "caevl": 60.0}
"""A step of the full networks on a modern data-centre GPU: assumed from their arithmetic and memory
traffic, not measured. The first minute of learning gives the true speed."""
TRAINED_BYTES, STORED_BYTES = 16, 12
"""Per parameter: weights, gradients and two moments; a checkpoint has no gradients."""
ACTIVATION_MB = 50.0
"""Of a tile of 256 px in the full auto-encoder, in float32."""
GB = 1e9


def steps(method: Method, tiles: int) -> int:
    """Steps of learning a network; 0 for a method without one."""
    recipe = make_variant(embed.TABLE, method.recipe)
    if not isinstance(recipe, AutoEncoderRecipe | TripletRecipe):
        return 0
    tuned = recipe.tuning_epochs if isinstance(recipe, CaevlRecipe) else 0
    return (recipe.epochs + tuned) * math.ceil(tiles / recipe.batch)


def parameters(method: Method) -> tuple[int, int]:
    """Parameters of a network, and of its encoder alone; zeros for a method without one."""
    import torch

    from orthonav.research.autoencoder import AutoEncoder
    from orthonav.research.triplet import ResNet34

    recipe = make_variant(embed.TABLE, method.recipe)
    with torch.device("meta"):
        if isinstance(recipe, AutoEncoderRecipe):
            model = AutoEncoder(width=recipe.width, dims=recipe.dims)
            return _count(model), _count(model.encoder)
        if isinstance(recipe, TripletRecipe):
            return 2 * (_count(ResNet34(width=recipe.width)),)
    return 0, 0


def _count(model: Any) -> int:
    return sum(values.numel() for values in model.parameters())


def lines(rows: Sequence[tuple[Scene, Method]], jobs: int, out: Path, on_gpu: bool) -> list[str]:
    """Lines that say steps, time, memory and disk of a series."""
    learnt = [(scene, method) for scene, method in rows if steps(method, 1)]
    text = []
    for family, step_ms in STEP_MS.items():
        count = sum(steps(m, s.trajectory.tiles) for s, m in learnt if m.family == family)
        if count:
            hours = f", {count * step_ms / 3.6e6:.1f} h at {step_ms:g} ms each" if on_gpu else ""
            text.append(f"{family}: {count:,} steps{hours}")
    whole, batches, encoders = 0, 0.0, 0
    for _, method in learnt:
        count, flown = parameters(method)
        whole, encoders = max(whole, count), encoders + flown
        recipe = make_variant(embed.TABLE, method.recipe)
        if isinstance(recipe, AutoEncoderRecipe):
            batches = max(batches, recipe.batch * ACTIVATION_MB / 1e3 * count / 172_506_561)
    memory_gb = jobs * (whole * TRAINED_BYTES / GB + batches)
    tiles = sum(scene.trajectory.tiles for scene, _ in rows)
    disk_gb = (jobs * whole * STORED_BYTES + encoders * 4 + tiles * 2 * 1024) / GB
    disk_gb += sum(
        _imagery_gb(scene) for scene in {scene.name: scene for scene, _ in rows}.values()
    )
    out.mkdir(parents=True, exist_ok=True)
    free_gb = shutil.disk_usage(out).free / GB
    text.append(f"memory for learning: about {memory_gb:.1f} GB")
    text.append(f"disk: at most {disk_gb:.1f} GB, {free_gb:.0f} GB are free")
    if disk_gb > free_gb:
        text.append("WARNING: the disk is too small; choose another folder with --out")
    return text


def _imagery_gb(scene: Scene) -> float:
    """Orthophotos of a scene, three bytes per pixel."""
    east_m, north_m = scene.trajectory.imagery_m
    return 3 * (2 + len(scene.others)) * east_m * north_m / scene.trajectory.gsd_m**2 / GB
