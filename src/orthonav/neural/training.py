"""Learning the neural encoders: one engine for the auto-encoder and the triplet network.

Both are learnt as Di Piazza et al. 2024 say (section Methodology): the auto-encoder with AdamW, a
rate of 3e-4 that halves on plateaus, batches of 32; the triplet network with Adam, 1e-3, batches
of 512; 200 epochs each. The order of tiles and every positive follow from the seed, the epoch and
the tile alone, so that a learning that was killed goes on as if it had not been.

Several processes or GPUs: start the program with `torchrun`. Each then takes its part of every
batch, gradients are averaged, the first one writes. Negatives and the statistics of batch norms
are those of a process's own part.
"""

import contextlib
import ctypes
import dataclasses
import json
import math
import os
import sys
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from orthonav.embed.network import AutoEncoderRecipe, NetworkEmbedder, TripletRecipe
from orthonav.errors import OrthonavError, OutputError
from orthonav.files import replacing, write_text
from orthonav.neural.autoencoder import AutoEncoder, Reconstruction, reconstructions
from orthonav.neural.export import export_encoder
from orthonav.neural.tiles import SheetTiles, epoch_batches, made_ahead
from orthonav.neural.triplet import Positive, Triplets

PLATEAU_FACTOR = 0.5
CALIBRATION_TILES, HELD_OUT_TILES = 64, 32
SETTLING_BATCHES = 32

Recipe = AutoEncoderRecipe | TripletRecipe
Report = Callable[[str, float], None]


class TrainingError(OrthonavError, RuntimeError):
    """Learning went wrong: the loss is no longer a number."""


@dataclass(frozen=True)
class Means:
    """How learning is made fast; what is learnt stays the same up to rounding.

    `bf16`: mixed precision, None where the processor multiplies bfloat16 itself. `channels_last`:
    memory layout of convolutions. `fused`: the optimizer's step in one pass over memory.
    `keep_memory`: freed memory stays with the process (Linux, CPU). `compile`: `torch.compile`,
    which needs a C++ compiler. `chunk`: most tiles of a triplet batch held for gradients at once;
    batch norms are then taken over each chunk. `workers`: threads that make batches.
    `save_every_s`: least time between checkpoints, s. `device`: None for a GPU where there is one.
    """

    bf16: bool | None = None
    channels_last: bool = True
    fused: bool = True
    keep_memory: bool = True
    compile: bool = False
    chunk: int = 128
    workers: int = 2
    save_every_s: float = 300.0
    device: str | None = None


class Task(Protocol):
    """What is learnt: a model, and how a batch becomes gradients."""

    @property
    def model(self) -> nn.Module:
        """What is learnt."""
        ...

    @property
    def encoder(self) -> nn.Module:
        """The part of it that flies."""
        ...

    def arrays(self, epoch: int, indices: NDArray[np.intp]) -> tuple[NDArray[Any], ...]:
        """What a batch of tiles (B,) needs; called from several threads."""
        ...

    def backward(self, run: nn.Module, *tensors: Tensor) -> Tensor:
        """Add the gradients of the loss, which is returned; `run` is the model, perhaps wrapped."""
        ...


def learn_network(
    recipe: Recipe,
    tiles: SheetTiles,
    *,
    binary: bool,
    seed: int,
    work: Path | None,
    positive: Positive | Sequence[SheetTiles] | None = None,
    report: Report | None = None,
    means: Means | None = None,
) -> NetworkEmbedder:
    """Learn an encoder from reference tiles and give what flies, checked against what was learnt.

    `binary`: the tiles are edge maps. `work`: folder for checkpoints, from which a learning that
    was interrupted goes on, and for pictures of its progress; None keeps nothing. `positive`: what
    a triplet's second picture is: sheets of other dates with the same tiles, or a function that
    changes grey levels. `report(text, share)` is told what is done and how much of it, 0 to 1.

    Raises `ValueError` for a triplet network without `positive` or for impossible tiles,
    `TrainingError` where the loss is no longer a number, `OutputError` where `work` holds another
    learning, `ExportError` where what flies would not be what was learnt.
    """
    means = means or Means()
    told = report or (lambda text, share: None)
    with kept_memory(means.keep_memory), _processes() as world:
        task = _task(recipe, tiles, binary=binary, positive=positive, seed=seed, means=means)
        train(task, recipe, tiles, seed=seed, work=work, report=told, means=means, world=world)
    told("export", 1.0)
    taken = np.unique(np.linspace(0, len(tiles) - 1, CALIBRATION_TILES).astype(np.intp))
    others = np.setdiff1d(np.arange(len(tiles)), taken)
    others = others if len(others) else taken
    held = others[np.unique(np.linspace(0, len(others) - 1, HELD_OUT_TILES).astype(np.intp))]
    # A GPU's convolutions round more than what flies does.
    encoder = task.encoder.to("cpu")
    made = export_encoder(encoder, recipe, tiles.batch(taken), tiles.batch(held))
    tried, size = made.cosine[recipe.precision], made.sizes_mb[made.precision]
    told(
        f"export: {made.precision}, {size:.1f} MB; cosine of {recipe.precision} to what was learnt "
        f"{tried:.4f}, {made.least_cosine:g} asked",
        1.0,
    )
    return made.embedder


def _task(
    recipe: Recipe,
    tiles: SheetTiles,
    *,
    binary: bool,
    positive: Positive | Sequence[SheetTiles] | None,
    seed: int,
    means: Means,
) -> Task:
    """The model with its first weights, which follow from the seed, and how it is learnt."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if isinstance(recipe, AutoEncoderRecipe):
            return Reconstruction(recipe, tiles, binary=binary)
        if positive is None:
            raise ValueError("a triplet network needs positives: sheets of other dates, or changes")
        if len(tiles) < 2:
            raise ValueError("a triplet network needs at least 2 tiles")
        return Triplets(recipe, tiles, positive, seed=seed, chunk=means.chunk)


@dataclass(frozen=True)
class World:
    """This process among those that learn together."""

    rank: int = 0
    size: int = 1
    local_rank: int = 0


def train(
    task: Task,
    recipe: Recipe,
    tiles: SheetTiles,
    *,
    seed: int,
    work: Path | None,
    report: Report,
    means: Means,
    world: World,
) -> list[float]:
    """Learn `task.model` in place, from its last checkpoint if any; the mean loss of each epoch."""
    device = _device(means, world)
    layout = torch.channels_last if means.channels_last else torch.contiguous_format
    task.model.to(device=device, memory_format=layout)  # type: ignore[call-overload]
    state = _State(task.model, recipe, fused=means.fused)
    store = _Store(work, _fingerprint(recipe, tiles, seed, means, world), means.save_every_s)
    store.load(state, device)
    run = _wrapped(task.model, device, means, world)
    bf16 = _uses_bf16(device) if means.bf16 is None else means.bf16
    feed = _Feed(task, recipe.batch, seed, len(tiles), device, layout, bf16, means, world)
    while len(state.history) < recipe.epochs:
        task.model.train()
        state.end_epoch(_mean_over_processes(_epoch(feed, run, state), world, device))
        done = len(state.history)
        text = f"epoch {done} of {recipe.epochs}, loss {state.history[-1]:.5g}"
        report(text, done / recipe.epochs)
        if world.rank == 0:
            store.save(state, task.model, tiles, last=done == recipe.epochs)
    _settle(feed)
    task.model.eval()
    return state.history


@dataclass(frozen=True, eq=False)
class _Feed:
    """Batches on their way to the device."""

    task: Task
    batch: int
    seed: int
    count: int
    device: torch.device
    layout: torch.memory_format
    bf16: bool
    means: Means
    world: World

    def batches(self, epoch: int, most: int | None = None) -> Iterator[list[Tensor]]:
        """Tensors of each batch of this process, of at most so many batches."""
        rank, size = self.world.rank, self.world.size
        plan = epoch_batches(self.count, self.batch, self.seed, epoch, rank=rank, processes=size)
        make = partial(self.task.arrays, epoch)
        for arrays in made_ahead(make, plan[:most], self.means.workers):
            yield [_on(self.device, array, self.layout) for array in arrays]

    def mixed(self) -> torch.autocast:
        """Mixed precision where it is wanted."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16)


def _epoch(feed: _Feed, run: nn.Module, state: "_State") -> Tensor:
    """Mean loss of one epoch of learning."""
    losses = []
    for tensors in feed.batches(len(state.history)):
        state.optimizer.zero_grad(set_to_none=True)
        with feed.mixed():
            losses.append(feed.task.backward(run, *tensors))
        state.optimizer.step()
    return torch.stack(losses).double().mean()


def _settle(feed: _Feed) -> None:
    """Give batch norms the means and variances that fit the final weights.

    Running ones lag some ten steps behind; a small area has few steps in an epoch, and then what
    flies would not be what was learnt. Of several processes those of the first one count.
    """
    model = feed.task.model
    norms = [module for module in model.modules() if isinstance(module, nn.BatchNorm2d)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # the plain mean over all batches
    model.train()
    with torch.no_grad(), feed.mixed():
        for maps, *_ in feed.batches(0, SETTLING_BATCHES):
            for part in torch.split(maps, max(2, feed.means.chunk // 2 * 2)):
                model(part)
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum
    if feed.world.size > 1:
        for values in model.buffers():
            distributed.broadcast(values, 0)


class _State:
    """What changes while learning: weights, optimizer, rate, and the losses so far."""

    def __init__(self, model: nn.Module, recipe: Recipe, *, fused: bool) -> None:
        kind = torch.optim.AdamW if isinstance(recipe, AutoEncoderRecipe) else torch.optim.Adam
        self.model = model
        self.optimizer: torch.optim.Optimizer = kind(
            model.parameters(), lr=recipe.learning_rate, fused=fused
        )
        self.plateau = None
        if isinstance(recipe, AutoEncoderRecipe):
            self.plateau = torch.optim.lr_scheduler.ReduceLROnPlateau(
                self.optimizer, factor=PLATEAU_FACTOR
            )
        self.history: list[float] = []

    def end_epoch(self, loss: float) -> None:
        """Keep the mean loss and lower the rate on a plateau; raises `TrainingError`."""
        if not math.isfinite(loss):
            raise TrainingError(
                f"loss is {loss} in epoch {len(self.history) + 1}: take a smaller learning_rate"
            )
        self.history.append(loss)
        if self.plateau is not None:
            self.plateau.step(loss)

    def parts(self) -> dict[str, Any]:
        """All of it, as a checkpoint holds it."""
        return {
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "plateau": self.plateau.state_dict() if self.plateau else None,
            "history": self.history,
        }

    def take(self, parts: dict[str, Any]) -> None:
        """Go on from what `parts` gave."""
        self.model.load_state_dict(parts["model"])
        self.optimizer.load_state_dict(parts["optimizer"])
        if self.plateau is not None:
            self.plateau.load_state_dict(parts["plateau"])
        self.history = list(parts["history"])


class _Store:
    """Checkpoints and pictures of one learning in a folder, or nowhere."""

    def __init__(self, work: Path | None, fingerprint: str, every_s: float) -> None:
        self._work, self._fingerprint, self._every_s = work, fingerprint, every_s
        self._saved_s = time.monotonic()

    def load(self, state: _State, device: torch.device) -> None:
        """Take the checkpoint, if there is one; raises `OutputError` if it is another's."""
        path = None if self._work is None else self._work / "checkpoint.pt"
        if path is None or not path.exists():
            return
        try:
            found = torch.load(path, map_location=device, weights_only=True)
            same = found.pop("fingerprint") == self._fingerprint
        except Exception as error:
            # Unpickling fails in as many ways as there are broken files.
            raise OutputError(f"checkpoint cannot be read; remove it: {path}") from error
        if not same:
            raise OutputError(f"folder holds a learning of something else; name another: {path}")
        state.take(found)

    def save(self, state: _State, model: nn.Module, tiles: SheetTiles, *, last: bool) -> None:
        """Write checkpoint and pictures if it is time; pictures also early on."""
        if self._work is None:
            return
        due = last or time.monotonic() - self._saved_s >= self._every_s
        if due:
            with replacing(self._work / "checkpoint.pt") as temporary:
                torch.save({"fingerprint": self._fingerprint, **state.parts()}, temporary)
            self._saved_s = time.monotonic()
        if due or len(state.history) in (1, 2, 5, 10, 20, 50):
            write_text(self._work / "history.json", json.dumps({"loss": state.history}) + "\n")
            _write_png(self._work / "loss.png", loss_picture(state.history))
            if isinstance(model, AutoEncoder):
                _write_png(self._work / "tiles.png", reconstructions(model, tiles))


def loss_picture(history: Sequence[float]) -> NDArray[np.uint8]:
    """Losses of all epochs (360, 640, 3), logarithmic, with the first, least and last told."""
    picture = np.full((360, 640, 3), 255, np.uint8)
    levels = np.log(np.maximum(np.asarray(history, np.float64), 1e-12))
    low, high = float(levels.min()), float(max(levels.max(), levels.min() + 1e-6))
    x = np.linspace(20, 620, len(levels)) if len(levels) > 1 else np.array([20.0])
    y = 340 - (levels - low) / (high - low) * 290
    points = np.stack([x, y], axis=1).round().astype(np.int32)
    cv2.polylines(picture, [points[:, None]], False, (160, 60, 20), 2, cv2.LINE_AA)
    text = f"epoch {len(history)}: loss {history[-1]:.4g} (first {history[0]:.4g}, "
    cv2.putText(picture, f"{text}least {min(history):.4g})", (20, 28), 0, 0.55, (0, 0, 0), 1, 16)
    return picture


def _write_png(path: Path, picture: NDArray[np.uint8]) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def _fingerprint(recipe: Recipe, tiles: SheetTiles, seed: int, means: Means, world: World) -> str:
    """What must be the same for a checkpoint to be this learning's."""
    some = np.unique(np.linspace(0, len(tiles) - 1, 64).astype(np.intp))
    where = np.ascontiguousarray(tiles.tiles_px, dtype=np.int64).tobytes()
    return json.dumps(
        {
            "recipe": [type(recipe).__name__, dataclasses.asdict(recipe)],
            "tiles": [zlib.crc32(where), zlib.crc32(tiles.batch(some).tobytes()), tiles.tile_px],
            "seed": seed,
            "means": [means.bf16, means.chunk, world.size],
        },
        sort_keys=True,
    )


def _on(device: torch.device, array: NDArray[Any], layout: torch.memory_format) -> Tensor:
    tensor = torch.from_numpy(np.ascontiguousarray(array))
    if tensor.ndim == 4:
        return tensor.to(device, memory_format=layout)
    return tensor.to(device)


def _device(means: Means, world: World) -> torch.device:
    name = means.device or ("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device("cuda", world.local_rank) if name == "cuda" else torch.device(name)


def _uses_bf16(device: torch.device) -> bool:
    """Whether the device multiplies bfloat16 itself; else float32 is faster."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    able = torch.cpu.get_capabilities()
    return any(bool(able.get(name)) for name in ("avx512_bf16", "amx_bf16", "bf16"))


def _wrapped(model: nn.Module, device: torch.device, means: Means, world: World) -> nn.Module:
    if world.size > 1:
        ids = [world.local_rank] if device.type == "cuda" else None
        model = DistributedDataParallel(model, device_ids=ids)
    return torch.compile(model) if means.compile else model  # type: ignore[return-value]


@contextlib.contextmanager
def _processes() -> Iterator[World]:
    """This process's place among those that torchrun started; alone where it did not."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield World()
        return
    ours = not distributed.is_initialized()
    if ours:
        distributed.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    try:
        local = int(os.environ.get("LOCAL_RANK", "0"))
        yield World(distributed.get_rank(), distributed.get_world_size(), local)
    finally:
        if ours:
            distributed.destroy_process_group()


def _mean_over_processes(value: Tensor, world: World, device: torch.device) -> float:
    if world.size > 1:
        value = value.to(device)
        distributed.all_reduce(value)
        value = value / world.size
    return float(value)


@contextlib.contextmanager
def kept_memory(wanted: bool) -> Iterator[None]:
    """Let glibc keep freed memory while this lasts, instead of giving it back to the system.

    Activations and gradients are hundreds of MB that come and go in every step; a system that
    fills each page with zeros anew costs as much as the arithmetic (mallopt(3)).
    """
    try:
        library = ctypes.CDLL(None) if wanted and sys.platform == "linux" else None
        mallopt, trim = library and library.mallopt, library and library.malloc_trim
    except (OSError, AttributeError):
        mallopt = trim = None
    if not mallopt or not trim:
        yield
        return
    trim_threshold, mmap_max = -1, -4
    mallopt(mmap_max, 0)
    mallopt(trim_threshold, -1)
    try:
        yield
    finally:
        mallopt(mmap_max, 65_536)
        mallopt(trim_threshold, 128 * 1024)
        trim(0)
