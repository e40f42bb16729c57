"""Training state and its checkpoints: an interrupted training resumes from its folder.

Checkpoints and pictures are written atomically, between batches and after epochs.
"""

import dataclasses
import json
import math
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from orthonav.core.errors import OrthonavError, OutputError
from orthonav.core.files import replacing, write_text
from orthonav.core.tiles.network import AutoEncoderRecipe, TripletRecipe
from orthonav.research.autoencoder import AutoEncoder, reconstructions
from orthonav.research.means import Means, World
from orthonav.research.tiles import SheetTiles

PLATEAU_FACTOR = 0.5
SHOWN_EPOCHS = (1, 2, 5, 10, 20, 50)
SHOWN_AFTER_S = (10.0, 60.0)
"""Early times at which pictures are written although no checkpoint is due, seconds."""

Recipe = AutoEncoderRecipe | TripletRecipe


class TrainingError(OrthonavError, RuntimeError):
    """The loss is not finite."""


class TrainingState:
    """State of a training: weights, optimizer, learning rate and losses.

    `history` holds the mean loss of each epoch, `losses` those of the batches of the current epoch.
    `scaler` scales gradients of float16 and does nothing for other types.
    """

    def __init__(
        self, model: nn.Module, recipe: Recipe, *, fused: bool, scaler: torch.amp.GradScaler
    ) -> None:
        kind = torch.optim.AdamW if isinstance(recipe, AutoEncoderRecipe) else torch.optim.Adam
        self.model, self.scaler = model, scaler
        self.optimizer: torch.optim.Optimizer = kind(
            model.parameters(), lr=recipe.learning_rate, fused=fused
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

    def parts(self) -> dict[str, Any]:
        """The state as a dictionary, for a checkpoint."""
        return {
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "plateau": self.plateau.state_dict() if self.plateau else None,
            "scaler": self.scaler.state_dict(),
            "history": self.history,
            "losses": self.losses,
        }

    def take(self, parts: dict[str, Any]) -> None:
        """Restore the state from `parts`."""
        self.model.load_state_dict(parts["model"])
        self.optimizer.load_state_dict(parts["optimizer"])
        if self.plateau is not None:
            self.plateau.load_state_dict(parts["plateau"])
        if parts.get("scaler"):
            self.scaler.load_state_dict(parts["scaler"])
        self.history = list(parts["history"])
        self.losses = list(parts.get("losses", []))  # absent in older checkpoints


class CheckpointStore:
    """Writes checkpoints and pictures of one training to a folder."""

    def __init__(self, work: Path | None, fingerprint: str, every_s: float) -> None:
        self._work, self._fingerprint, self._every_s = work, fingerprint, every_s
        self._saved_s = self._began_s = time.monotonic()
        self._early_s = list(SHOWN_AFTER_S)

    def load(self, state: TrainingState, device: torch.device, epochs: int) -> None:
        """Restore any checkpoint.

        Raises `OutputError` if it belongs to another training, or has more than `epochs` epochs.
        """
        path = None if self._work is None else self._work / "checkpoint.pt"
        if path is None or not path.exists():
            return
        try:
            found = torch.load(path, map_location=device, weights_only=True)
            same = found.pop("fingerprint") == self._fingerprint
        except Exception as error:
            # Unpickling a broken file may raise any exception.
            raise OutputError(f"checkpoint cannot be read; delete it: {path}") from error
        if not same:
            raise OutputError(f"folder holds another training; choose another folder: {path}")
        if len(found["history"]) > epochs:
            raise OutputError(
                f"folder holds a training of {len(found['history'])} epochs, {epochs} are asked "
                f"for; give as many, or choose another folder: {path}"
            )
        state.take(found)

    def clear(self) -> None:
        """Remove temporary files of interrupted writes, which may hold gigabytes."""
        for left in self._work.glob(".checkpoint.pt.*.tmp.pt") if self._work else ():
            left.unlink(missing_ok=True)

    def after_batch(self, state: TrainingState, tiles: SheetTiles) -> None:
        """Write a checkpoint if one is due; write pictures with it, and early in the training."""
        now_s = time.monotonic()
        early = bool(self._early_s) and now_s - self._began_s >= self._early_s[0]
        if early:
            self._early_s.pop(0)
        self._write(state, tiles, due=now_s - self._saved_s >= self._every_s, shown=early)

    def after_epoch(self, state: TrainingState, tiles: SheetTiles, *, last: bool) -> None:
        """Write a checkpoint if one is due, and always after the last epoch."""
        due = last or time.monotonic() - self._saved_s >= self._every_s
        self._write(state, tiles, due=due, shown=len(state.history) in SHOWN_EPOCHS)

    def _write(self, state: TrainingState, tiles: SheetTiles, *, due: bool, shown: bool) -> None:
        if self._work is None or not (due or shown):
            return
        if due:
            with replacing(self._work / "checkpoint.pt") as temporary:
                torch.save({"fingerprint": self._fingerprint, **state.parts()}, temporary)
            self._saved_s = time.monotonic()
        write_text(self._work / "history.json", json.dumps({"loss": state.history}) + "\n")
        picture = loss_picture(state.history)
        if not state.history:
            picture = loss_picture([float(loss) for loss in state.losses], "batch")
        _write_png(self._work / "loss.png", picture)
        if isinstance(state.model, AutoEncoder):
            _write_png(self._work / "tiles.png", reconstructions(state.model, tiles))


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
    world: World,
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
        "means": [means.bf16, means.chunk, world.size],
    }
    if dates:
        key["dates"] = [zlib.crc32(date.batch(some).tobytes()) for date in dates]
    return json.dumps(key, sort_keys=True)
