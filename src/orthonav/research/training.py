"""Trains the neural encoders: one engine for the auto-encoder, the triplet network and CAEVL.

Both of the paper are trained as in Di Piazza et al. 2024 (section Methodology, Considered methods):
the auto-encoder with AdamW, a rate of 3e-4 that halves on plateaus, batches of 32; the triplet
network with Adam, 1e-3, batches of 512; 200 epochs each. The rest is our choice: plateaus are seen
in the mean training loss; patience (10 epochs) and weight decay (0.01 for AdamW, 0 for Adam) are
PyTorch's defaults; tiles are neither augmented nor held out for validation.

The order of tiles and every positive depend on the seed, the epoch and the tile alone. An
interrupted training therefore resumes with the same result, also within an epoch, and a finished
one goes on where it is given more epochs. Checkpoints and pictures are written atomically, between
batches and after epochs.

Tensors stay contiguous (NCHW) on every device. In `channels_last` oneDNN writes past a buffer in
the backward pass of strided 1 x 1 convolutions with fewer channels than its block: the shortcuts
of a narrow ResNet. On processors with AVX2 only, the gradients are then wrong, or the process
crashes or hangs (oneDNN issue 6035, present in PyTorch 2.13.0). `torch.compile` is not used,
because on a CPU it chooses `channels_last` itself.
"""

import contextlib
import ctypes
import dataclasses
import json
import logging
import math
import sys
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from orthonav.core.cores import in_order, usable_cores
from orthonav.core.errors import OrthonavError, OutputError
from orthonav.core.files import Progress, replacing, write_text
from orthonav.core.tiles.network import AutoEncoderRecipe, NetworkEmbedder, TripletRecipe
from orthonav.research.autoencoder import AutoEncoder, Reconstruction, reconstructions
from orthonav.research.export import export_encoder
from orthonav.research.tiles import SheetTiles, epoch_batches
from orthonav.research.triplet import Positive, Triplets

log = logging.getLogger(__name__)

GPU_WORKERS = 16
"""Threads that make batches for a GPU: more tiles than one thread cuts, and positives take far
longer than tiles."""
CALIBRATION_TILES, HELD_OUT_TILES = 64, 32
SETTLING_BATCHES = 32
PROGRESS_EVERY_S = 2.0
PLATEAU_FACTOR = 0.5

Recipe = AutoEncoderRecipe | TripletRecipe


@dataclass(frozen=True)
class Means:
    """Options for the speed of training; the learned weights are the same up to rounding.

    `bf16`: mixed precision with bfloat16; None: if the processor has its instructions, else with
    float16 on a GPU.
    """

    bf16: bool | None = None
    chunk: int = 128  # tiles of a triplet batch held for gradients at once, and of a batch norm
    workers: int | None = None  # threads that make batches; None: 2, one per core for a GPU
    save_every_s: float = 300.0  # shortest time between checkpoints
    device: str | None = None  # name for PyTorch; None: a GPU if there is one


def device_of(means: Means) -> torch.device:
    return torch.device(means.device or ("cuda" if torch.cuda.is_available() else "cpu"))


def mixed_precision(means: Means, device: torch.device) -> torch.dtype | None:
    """Type for mixed precision: as `means.bf16` says, else bfloat16 if the device supports it.

    A GPU without it, before NVIDIA's Ampere, gets float16; on other processors float32 is faster.
    """
    if means.bf16 is not None:
        return torch.bfloat16 if means.bf16 else None
    if device.type == "cuda":
        able = torch.cuda.is_bf16_supported(including_emulation=False)
        return torch.bfloat16 if able else torch.float16
    # Older releases of PyTorch lack this function.
    found: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    able = any(bool(found.get(name)) for name in ("avx512_bf16", "amx_bf16", "bf16"))
    return torch.bfloat16 if able else None


def workers_of(means: Means, device: torch.device) -> int:
    if means.workers is not None:
        return means.workers
    return min(GPU_WORKERS, usable_cores()) if device.type == "cuda" else 2


@contextlib.contextmanager
def _kept_memory() -> Iterator[None]:
    """Let glibc keep freed memory while this lasts, instead of returning it to the system.

    Every step allocates and frees hundreds of MB of activations and gradients. Zero-filled pages
    from the system cost as much as the arithmetic (mallopt(3)).
    """
    library: Any = ctypes.CDLL(None) if sys.platform == "linux" else None
    if not hasattr(library, "mallopt") or not hasattr(library, "malloc_trim"):
        yield
        return
    trim_threshold, mmap_max = -1, -4
    library.mallopt(mmap_max, 0)
    library.mallopt(trim_threshold, -1)
    try:
        yield
    finally:
        library.mallopt(mmap_max, 65_536)
        library.mallopt(trim_threshold, 128 * 1024)
        library.malloc_trim(0)


class Task(Protocol):
    """A training task: a model, and how a batch becomes gradients."""

    @property
    def model(self) -> nn.Module: ...

    @property
    def encoder(self) -> nn.Module:
        """The part of the model that flies."""
        ...

    def arrays(self, epoch: int, indices: NDArray[np.intp]) -> tuple[NDArray[Any], ...]:
        """Arrays for a batch of tiles (B,); called from several threads."""
        ...

    def backward(self, *tensors: Tensor, scale: Tensor) -> Tensor:
        """Loss, after adding its gradients times `scale`."""
        ...


class TrainingError(OrthonavError, RuntimeError):
    """The loss is not finite."""


class TrainingState:
    """State of a training: weights, optimizer, learning rate and losses.

    `history` holds the mean loss of each epoch, `losses` those of the batches of the current epoch.
    `scaler` scales gradients of float16 and does nothing for other types.
    """

    def __init__(self, model: nn.Module, recipe: Recipe, scaler: torch.amp.GradScaler) -> None:
        kind = torch.optim.AdamW if isinstance(recipe, AutoEncoderRecipe) else torch.optim.Adam
        self.model, self.scaler = model, scaler
        self.optimizer: torch.optim.Optimizer = kind(
            model.parameters(), lr=recipe.learning_rate, fused=True
        )
        self.plateau = None
        if isinstance(recipe, AutoEncoderRecipe):
            self.plateau = torch.optim.lr_scheduler.ReduceLROnPlateau(
                self.optimizer, factor=PLATEAU_FACTOR
            )
        self.history: list[float] = []
        self.losses: list[Tensor] = []

    def end_epoch(self, loss: float) -> None:
        """Store the mean loss and lower the rate on a plateau; raises `TrainingError`."""
        if not math.isfinite(loss):
            raise TrainingError(
                f"loss is {loss} in epoch {len(self.history) + 1}: use a smaller learning_rate"
            )
        self.history.append(loss)
        self.losses = []
        if self.plateau is not None:
            self.plateau.step(loss)

    def _with_states(self) -> dict[str, Any]:
        names = "model", "optimizer", "plateau", "scaler"
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    def parts(self) -> dict[str, Any]:
        states = {name: each.state_dict() for name, each in self._with_states().items()}
        return {"plateau": None, **states, "history": self.history, "losses": self.losses}

    def take(self, parts: dict[str, Any]) -> None:
        for name, each in self._with_states().items():
            if name != "scaler" or parts.get(name):
                each.load_state_dict(parts[name])
        self.history = list(parts["history"])
        self.losses = list(parts.get("losses", []))  # absent in older checkpoints


class Training:
    """One training of `task.model`, in place: its batches, epochs, reports and checkpoints.

    `dates`: sheets of the positives, part of the key of a checkpoint. The other arguments are those
    of `learn_network`.
    """

    def __init__(
        self,
        task: Task,
        recipe: Recipe,
        tiles: SheetTiles,
        *,
        seed: int,
        work: Path | None,
        report: Progress,
        means: Means,
        dates: Sequence[SheetTiles] = (),
    ) -> None:
        self.task, self.recipe, self.tiles, self.means = task, recipe, tiles, means
        self.seed, self.work, self.report = seed, work, report
        self.device = device_of(means)
        self.mixed = mixed_precision(means, self.device)
        task.model.to(self.device)
        scaler = torch.amp.GradScaler(self.device.type, enabled=self.mixed == torch.float16)
        self.state = TrainingState(task.model, recipe, scaler)
        self.batches_per_epoch = math.ceil(len(tiles) / recipe.batch)
        self._key = fingerprint(recipe, tiles, dates, seed, means)
        self._load()
        self._start, self._start_s = self._share(), time.monotonic()
        self._said_s = self._saved_s = self._start_s

    def run(self) -> None:
        """Train from the checkpoint, if there is one, to the last epoch."""
        kind = self.mixed or torch.float32
        log.info("training on %s in %s, contiguous tensors (NCHW)", self.device, kind)
        state, model = self.state, self.task.model
        # By default convolutions on a GPU are not deterministic.
        with _kept_memory(), torch.backends.cudnn.flags(enabled=True, deterministic=True):
            while len(state.history) < self.recipe.epochs:
                model.train()
                self._epoch()
                loss = state.history[-1]
                self._say(f"epoch {len(state.history)} of {self.recipe.epochs}, loss {loss:.5g}")
                self._save(last=len(state.history) == self.recipe.epochs)
            self._settle()
        model.eval()

    def batches(self, epoch: int, first: int = 0, end: int | None = None) -> Iterator[list[Tensor]]:
        """Tensors of each batch, from number `first` up to `end`, exclusive."""
        plan = epoch_batches(len(self.tiles), self.recipe.batch, self.seed, epoch)
        workers = workers_of(self.means, self.device)
        for tensors in in_order(partial(self.batch, epoch), plan[first:end], workers):
            yield [each.to(self.device, non_blocking=True) for each in tensors]

    def batch(self, epoch: int, indices: NDArray[np.intp]) -> list[Tensor]:
        """Tensors of a batch, for a GPU in pinned memory, from which copies are asynchronous."""
        arrays = self.task.arrays(epoch, indices)
        made = [torch.from_numpy(np.ascontiguousarray(each)) for each in arrays]
        return [each.pin_memory() for each in made] if self.device.type == "cuda" else made

    def _autocast(self) -> torch.autocast:
        kind = self.mixed or torch.bfloat16
        return torch.autocast(self.device.type, kind, enabled=self.mixed is not None)

    def _epoch(self) -> None:
        """A resumed epoch starts after its finished batches."""
        state, one = self.state, torch.ones((), device=self.device)
        for tensors in self.batches(len(state.history), len(state.losses)):
            state.optimizer.zero_grad(set_to_none=True)
            with self._autocast():
                loss = self.task.backward(*tensors, scale=state.scaler.scale(one))
            state.losses.append(loss)
            state.scaler.step(state.optimizer)
            state.scaler.update()
            done = len(state.losses)
            if done == self.batches_per_epoch:  # reported and saved as an epoch
                continue
            if time.monotonic() - self._said_s >= PROGRESS_EVERY_S:
                at = f"epoch {len(state.history) + 1} of {self.recipe.epochs}, batch {done} of "
                self._say(f"{at}{self.batches_per_epoch}, loss {float(loss):.5g}")
            self._save(last=False)
        state.end_epoch(float(torch.stack(state.losses).double().mean()))

    def _settle(self) -> None:
        """Recompute the means and variances of batch norms for the final weights.

        Running averages lag some ten steps behind, and a small area has few steps in an epoch.
        """
        model = self.task.model
        norms = [module for module in model.modules() if isinstance(module, nn.BatchNorm2d)]
        momenta = [norm.momentum for norm in norms]
        for norm in norms:
            norm.reset_running_stats()
            norm.momentum = None  # plain mean over all batches
        model.train()
        with torch.no_grad(), self._autocast():
            for maps, *_ in self.batches(0, end=SETTLING_BATCHES):
                for part in torch.split(maps, max(2, self.means.chunk // 2 * 2)):
                    model(part)
        for norm, momentum in zip(norms, momenta, strict=True):
            norm.momentum = momentum

    def _load(self) -> None:
        """Restore any checkpoint, and remove temporary files of interrupted writes.

        Raises `OutputError` if it belongs to another training, or has more epochs.
        """
        for left in self.work.glob(".checkpoint.pt.*.tmp.pt") if self.work else ():
            left.unlink(missing_ok=True)
        path = None if self.work is None else self.work / "checkpoint.pt"
        if path is None or not path.exists():
            return
        try:
            found = torch.load(path, map_location=self.device, weights_only=True)
            same = found.pop("fingerprint") == self._key
        except Exception as error:
            # Unpickling a broken file may raise any exception.
            raise OutputError(f"checkpoint cannot be read; delete it: {path}") from error
        if not same:
            raise OutputError(f"folder holds another training; choose another folder: {path}")
        if len(found["history"]) > self.recipe.epochs:
            raise OutputError(
                f"folder holds a training of {len(found['history'])} epochs, {self.recipe.epochs} "
                f"are asked for; give as many, or choose another folder: {path}"
            )
        self.state.take(found)

    def _save(self, *, last: bool) -> None:
        """Write checkpoint, losses and pictures, unless the last ones are recent."""
        state, due_s = self.state, self._saved_s + self.means.save_every_s
        if self.work is None or not (last or time.monotonic() >= due_s):
            return
        with replacing(self.work / "checkpoint.pt") as temporary:
            torch.save({"fingerprint": self._key, **state.parts()}, temporary)
        self._saved_s = time.monotonic()
        write_text(self.work / "history.json", json.dumps({"loss": state.history}) + "\n")
        picture = loss_picture(state.history)
        if not state.history:
            picture = loss_picture([float(loss) for loss in state.losses], "batch")
        _write_png(self.work / "loss.png", picture)
        if isinstance(state.model, AutoEncoder):
            _write_png(self.work / "tiles.png", reconstructions(state.model, self.tiles))

    def _share(self) -> float:
        batches = len(self.state.history) * self.batches_per_epoch + len(self.state.losses)
        return batches / (self.recipe.epochs * self.batches_per_epoch)

    def _say(self, text: str) -> None:
        """Report with the time left, at the speed since this process began."""
        self._said_s, share = time.monotonic(), self._share()
        speed = (share - self._start) / max(self._said_s - self._start_s, 1e-9)
        left = f", {_duration((1 - share) / speed)} left" if speed > 0 and share < 1 else ""
        self.report(f"{text}{left}", share)


def loss_picture(history: Sequence[float], unit: str = "epoch") -> NDArray[np.uint8]:
    """Plot (360, 640, 3) of the losses, logarithmic; its title gives the first, least and last one.

    `unit`: "epoch" or "batch". The plot is blank without losses or if one of them is not finite.
    """
    picture = np.full((360, 640, 3), 255, np.uint8)
    if not history or not np.isfinite(history).all():
        return picture
    levels = np.log(np.maximum(np.asarray(history, np.float64), 1e-12))
    low, high = float(levels.min()), float(max(levels.max(), levels.min() + 1e-6))
    x = np.linspace(20, 620, len(levels)) if len(levels) > 1 else np.array([20.0])
    y = 340 - (levels - low) / (high - low) * 290
    points = np.stack([x, y], axis=1).round().astype(np.int32)
    cv2.polylines(picture, [points[:, None]], False, (160, 60, 20), 2, cv2.LINE_AA)
    text = f"{unit} {len(history)}: loss {history[-1]:.4g} (first {history[0]:.4g}, "
    cv2.putText(picture, f"{text}least {min(history):.4g})", (20, 28), 0, 0.55, (0, 0, 0), 1, 16)
    return picture


def _write_png(path: Path, picture: NDArray[np.uint8]) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def fingerprint(
    recipe: Recipe,
    tiles: SheetTiles,
    dates: Sequence[SheetTiles],
    seed: int,
    means: Means,
) -> str:
    """Key of a training: a checkpoint with another key is refused; `dates` are other sheets."""
    some = np.unique(np.linspace(0, len(tiles) - 1, 64).astype(np.intp))
    where = np.ascontiguousarray(tiles.tiles_px, dtype=np.int64).tobytes()
    # Precision is chosen after training, and epochs can be added.
    learnt = dataclasses.asdict(recipe) | {"precision": "float32", "epochs": 0}
    key: dict[str, Any] = {
        "recipe": [type(recipe).__name__, learnt],
        "tiles": [zlib.crc32(where), zlib.crc32(tiles.batch(some).tobytes()), tiles.tile_px],
        "seed": seed,
        "means": [means.bf16, means.chunk, 1],
    }
    if dates:
        key["dates"] = [zlib.crc32(date.batch(some).tobytes()) for date in dates]
    return json.dumps(key, sort_keys=True)


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
    task = _task(recipe, tiles, binary=binary, positive=positive, seed=seed, means=means)
    dates = () if positive is None or callable(positive) else positive
    given: dict[str, Any] = {"seed": seed, "work": work, "report": progress, "means": means}
    Training(task, recipe, tiles, dates=dates, **given).run()
    return finished(task.encoder, recipe, tiles, progress, means)


def finished(
    encoder: nn.Module, recipe: Recipe, tiles: SheetTiles, progress: Progress, means: Means
) -> TrainedNetwork:
    """Trained encoder with its ONNX embedder, checked on tiles of the map."""
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
    device = device_of(means)
    return TrainedNetwork(made.embedder, encoder.to(device).eval(), device)


def _task(
    recipe: Recipe,
    tiles: SheetTiles,
    *,
    binary: bool,
    positive: Positive | Sequence[SheetTiles] | None,
    seed: int,
    means: Means,
) -> Task:
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


def _duration(seconds: float) -> str:
    """Seconds in the unit that people would name."""
    for size, name in ((3600, "h"), (60, "min")):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.{int(seconds < 10 * size)}f} {name}"
    return f"{seconds:.0f} s"
