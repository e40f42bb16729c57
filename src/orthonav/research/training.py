"""Trains the neural encoders: one engine for the auto-encoder and the triplet network.

Both are trained as in Di Piazza et al. 2024 (section Methodology): the auto-encoder with AdamW, a
rate of 3e-4 that halves on plateaus, batches of 32; the triplet network with Adam, 1e-3, batches
of 512; 200 epochs each. The order of tiles and every positive depend on the seed, the epoch and
the tile alone. An interrupted training therefore resumes with the same result, also within an
epoch, and a finished one goes on where it is given more epochs.

Several processes or GPUs: start the program with `torchrun`. Each process takes its share of every
batch, gradients are averaged, and the first process writes. Negatives and the statistics of batch
norms come from the share of each process.
"""

import logging
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, distributed, nn

from orthonav.core.files import Progress
from orthonav.core.tiles.network import AutoEncoderRecipe, NetworkEmbedder
from orthonav.research.autoencoder import Reconstruction
from orthonav.research.checkpoints import CheckpointStore, Recipe, TrainingState, fingerprint
from orthonav.research.export import export_encoder
from orthonav.research.means import (
    Means,
    World,
    device_of,
    kept_memory,
    mean_over_processes,
    mixed_precision,
    processes,
    workers_of,
    wrapped,
)
from orthonav.research.tiles import SheetTiles, epoch_batches, made_ahead
from orthonav.research.triplet import Positive, Triplets

log = logging.getLogger(__name__)

CALIBRATION_TILES, HELD_OUT_TILES = 64, 32
SETTLING_BATCHES = 32
PROGRESS_EVERY_S = 2.0


class Task(Protocol):
    """A training task: a model, and how a batch becomes gradients."""

    @property
    def model(self) -> nn.Module:
        """The trained model."""
        ...

    @property
    def encoder(self) -> nn.Module:
        """The part of the model that flies."""
        ...

    def arrays(self, epoch: int, indices: NDArray[np.intp]) -> tuple[NDArray[Any], ...]:
        """Arrays for a batch of tiles (B,); called from several threads."""
        ...

    def backward(self, run: nn.Module, *tensors: Tensor, scale: Tensor) -> Tensor:
        """Loss, after adding its gradients times `scale`; `run` is the model, possibly wrapped."""
        ...


@dataclass(frozen=True, eq=False)
class TrainedNetwork:
    """A trained encoder: `embedder` as it flies, `encoder` on the device where it was trained."""

    embedder: NetworkEmbedder
    encoder: nn.Module
    device: torch.device

    def views(self, maps: NDArray[np.float32]) -> NDArray[np.float32]:
        """Embeddings (N, D) of tiles (N, C, S, S): on a GPU if it learnt, else as in flight.

        A precision below float32 is always computed as in flight.
        """
        recipe = self.embedder.recipe
        if self.device.type == "cpu" or recipe.precision != "float32":
            return self.embedder.views(maps)
        # TF32 would round like no other device.
        with torch.no_grad(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            found = self.encoder(torch.from_numpy(maps).to(self.device)).float()
        if recipe.similarity == "cosine":
            found = nn.functional.normalize(found, dim=1)
        return np.asarray(found.cpu().numpy())


def learn_network(
    recipe: Recipe,
    tiles: SheetTiles,
    *,
    binary: bool,
    seed: int,
    work: Path | None,
    positive: Positive | Sequence[SheetTiles] | None = None,
    report: Progress | None = None,
    means: Means | None = None,
) -> TrainedNetwork:
    """Encoder trained on reference tiles, with its ONNX embedder checked against PyTorch.

    - `binary`: the tiles are edge maps.
    - `seed`: seed of the weights, of the order of tiles and of the positives.
    - `work`: folder for checkpoints and pictures of the progress; an interrupted training resumes
      from it, and a finished one if the recipe has more epochs; None: nothing is written.
    - `positive`: source of the positives of triplets: sheets of other dates with the same tiles, or
      a function that changes grey levels.
    - `report(text, share)`: progress callback; `share` is the part done, 0 to 1.
    - `means`: options for speed.

    Raises `ValueError` for a triplet network without `positive` or for impossible tiles,
    `TrainingError` if the loss is not finite, `OutputError` if `work` holds another training,
    `ExportError` if ONNX and PyTorch disagree.
    """
    means = means or Means()
    progress = report or (lambda text, share: None)
    with kept_memory(means.keep_memory), processes(means) as world:
        task = _task(recipe, tiles, binary=binary, positive=positive, seed=seed, means=means)
        dates = () if positive is None or callable(positive) else positive
        train(
            task,
            recipe,
            tiles,
            dates=dates,
            seed=seed,
            work=work,
            report=progress,
            means=means,
            world=world,
        )
        device = device_of(means, world)
    embedder = _exported(task.encoder, recipe, tiles, progress)
    return TrainedNetwork(embedder, task.encoder.to(device).eval(), device)


def _exported(
    encoder: nn.Module, recipe: Recipe, tiles: SheetTiles, progress: Progress
) -> NetworkEmbedder:
    """ONNX embedder in the recipe's precision if that is accurate enough on tiles of the map."""
    progress("export", 1.0)
    taken = np.unique(np.linspace(0, len(tiles) - 1, CALIBRATION_TILES).astype(np.intp))
    others = np.setdiff1d(np.arange(len(tiles)), taken)
    others = others if len(others) else taken
    held = others[np.unique(np.linspace(0, len(others) - 1, HELD_OUT_TILES).astype(np.intp))]
    # Convolutions on a GPU round more than ONNX on a CPU.
    made = export_encoder(encoder.to("cpu"), recipe, tiles.batch(taken), tiles.batch(held))
    tried, size = made.cosine[recipe.precision], made.sizes_mb[made.precision]
    progress(
        f"export: {made.precision}, {size:.1f} MB; cosine between {recipe.precision} and the "
        f"trained encoder {tried:.4f}, at least {made.least_cosine:g} required",
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
    """Training task of a recipe, with initial weights drawn from the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if isinstance(recipe, AutoEncoderRecipe):
            return Reconstruction(recipe, tiles, binary=binary)
        if positive is None:
            raise ValueError(
                "a triplet network needs positives: sheets of other dates or a function"
            )
        if len(tiles) < 2:
            raise ValueError("a triplet network needs at least 2 tiles")
        return Triplets(recipe, tiles, positive, seed=seed, chunk=means.chunk)


def train(
    task: Task,
    recipe: Recipe,
    tiles: SheetTiles,
    *,
    seed: int,
    work: Path | None,
    report: Progress,
    means: Means,
    world: World,
    dates: Sequence[SheetTiles] = (),
) -> list[float]:
    """Mean loss of each epoch, after training `task.model` in place from any checkpoint.

    `dates`: sheets of the positives, part of the key of a checkpoint. With several processes all
    read the checkpoint, so `work` must be a shared folder.
    """
    device = device_of(means, world)
    mixed = mixed_precision(means, device)
    log.info("training on %s in %s, contiguous tensors (NCHW)", device, mixed or torch.float32)
    task.model.to(device)
    scaler = torch.amp.GradScaler(device.type, enabled=mixed == torch.float16)
    state = TrainingState(task.model, recipe, fused=means.fused, scaler=scaler)
    known_by = fingerprint(recipe, tiles, dates, seed, means, world)
    store = CheckpointStore(work, known_by, means.save_every_s)
    store.load(state, device, recipe.epochs)
    run = wrapped(task.model, device, world)
    feed = _Feed(task, recipe.batch, seed, len(tiles), device, mixed, means, world)
    writer = store if world.rank == 0 else None
    if writer:
        writer.clear()
    pauses = _Pauses(state, tiles, recipe.epochs, feed.per_epoch, report, writer)
    # By default convolutions on a GPU are not deterministic.
    with torch.backends.cudnn.flags(enabled=True, deterministic=True):
        while len(state.history) < recipe.epochs:
            task.model.train()
            loss = _epoch(feed, run, state, pauses)
            state.end_epoch(mean_over_processes(loss, world, device))
            pauses.after_epoch()
        _settle(feed)
    task.model.eval()
    return state.history


class _Pauses:
    """Reports progress and writes checkpoints; `writer` is None where another process writes."""

    def __init__(
        self,
        state: TrainingState,
        tiles: SheetTiles,
        epochs: int,
        batches: int,
        report: Progress,
        writer: CheckpointStore | None,
    ) -> None:
        self._state, self._tiles = state, tiles
        self._epochs, self._batches = epochs, batches
        self._report, self._writer = report, writer
        self._progress_s = self._start_s = time.monotonic()
        self._start = self._share()

    def after_batch(self) -> None:
        """Report and write if due; the last batch of an epoch is left to `after_epoch`."""
        epoch, done = len(self._state.history), len(self._state.losses)
        if done == self._batches:
            return
        if time.monotonic() - self._progress_s >= PROGRESS_EVERY_S:
            at = f"epoch {epoch + 1} of {self._epochs}, batch {done} of {self._batches}"
            self._say(f"{at}, loss {float(self._state.losses[-1]):.5g}")
        if self._writer:
            self._writer.after_batch(self._state, self._tiles)

    def after_epoch(self) -> None:
        """Report the mean loss, and write if due."""
        history = self._state.history
        done = len(history)
        self._say(f"epoch {done} of {self._epochs}, loss {history[-1]:.5g}")
        if self._writer:
            self._writer.after_epoch(self._state, self._tiles, last=done == self._epochs)

    def _share(self) -> float:
        """Share of the training that is done."""
        batches = len(self._state.history) * self._batches + len(self._state.losses)
        return batches / (self._epochs * self._batches)

    def _say(self, text: str) -> None:
        """Report with the time left, at the speed since this process began."""
        self._progress_s, share = time.monotonic(), self._share()
        speed = (share - self._start) / max(self._progress_s - self._start_s, 1e-9)
        left = f", {_duration((1 - share) / speed)} left" if speed > 0 and share < 1 else ""
        self._report(f"{text}{left}", share)


def _duration(seconds: float) -> str:
    """Seconds in the unit that people would name."""
    for size, name in ((3600, "h"), (60, "min")):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.{int(seconds < 10 * size)}f} {name}"
    return f"{seconds:.0f} s"


@dataclass(frozen=True, eq=False)
class _Feed:
    """Makes batches and moves them to the device."""

    task: Task
    batch: int
    seed: int
    count: int
    device: torch.device
    precision: torch.dtype | None
    means: Means
    world: World

    @property
    def per_epoch(self) -> int:
        """Number of batches of an epoch."""
        return math.ceil(self.count / self.batch)

    def batches(self, epoch: int, first: int = 0, end: int | None = None) -> Iterator[list[Tensor]]:
        """Tensors of each batch of this process, from number `first` up to `end`, exclusive."""
        rank, size = self.world.rank, self.world.size
        plan = epoch_batches(self.count, self.batch, self.seed, epoch, rank=rank, processes=size)
        workers = workers_of(self.means, self.device)
        for tensors in made_ahead(partial(self._made, epoch), plan[first:end], workers):
            yield [each.to(self.device, non_blocking=True) for each in tensors]

    def _made(self, epoch: int, indices: NDArray[np.intp]) -> list[Tensor]:
        """Tensors of a batch, for a GPU in pinned memory, from which copies are asynchronous."""
        arrays = self.task.arrays(epoch, indices)
        made = [torch.from_numpy(np.ascontiguousarray(each)) for each in arrays]
        return [each.pin_memory() for each in made] if self.device.type == "cuda" else made

    def mixed(self) -> torch.autocast:
        """Autocast context for mixed precision."""
        wanted, kind = self.precision is not None, self.precision or torch.bfloat16
        return torch.autocast(self.device.type, kind, enabled=wanted)


def _epoch(feed: _Feed, run: nn.Module, state: TrainingState, pauses: _Pauses) -> Tensor:
    """Mean loss of one epoch; a resumed epoch starts after its finished batches.

    With several processes, all resume with the losses of the first one.
    """
    one = torch.ones((), device=feed.device)
    for tensors in feed.batches(len(state.history), len(state.losses)):
        state.optimizer.zero_grad(set_to_none=True)
        with feed.mixed():
            loss = feed.task.backward(run, *tensors, scale=state.scaler.scale(one))
        state.losses.append(loss)
        state.scaler.step(state.optimizer)
        state.scaler.update()
        pauses.after_batch()
    return torch.stack(state.losses).double().mean()


def _settle(feed: _Feed) -> None:
    """Recompute the means and variances of batch norms for the final weights.

    Running averages lag some ten steps behind, and a small area has few steps in an epoch. With
    several processes the statistics of the first one are used.
    """
    model = feed.task.model
    norms = [module for module in model.modules() if isinstance(module, nn.BatchNorm2d)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # plain mean over all batches
    model.train()
    with torch.no_grad(), feed.mixed():
        for maps, *_ in feed.batches(0, end=SETTLING_BATCHES):
            for part in torch.split(maps, max(2, feed.means.chunk // 2 * 2)):
                model(part)
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum
    if feed.world.size > 1:
        for values in model.buffers():
            distributed.broadcast(values, 0)
