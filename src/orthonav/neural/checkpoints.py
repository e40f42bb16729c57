"""What changes while a network learns, kept in a folder so that a learning that was killed goes on.

Checkpoints and pictures are written whole or not at all, between batches and after epochs.
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

from orthonav.embed.network import AutoEncoderRecipe, TripletRecipe
from orthonav.errors import OrthonavError, OutputError
from orthonav.files import replacing, write_text
from orthonav.neural.autoencoder import AutoEncoder, reconstructions
from orthonav.neural.means import Means, World
from orthonav.neural.tiles import SheetTiles

PLATEAU_FACTOR = 0.5
SHOWN_EPOCHS = (1, 2, 5, 10, 20, 50)
SHOWN_AFTER_S = (10.0, 60.0)
"""When pictures are written though no checkpoint is due: early, to see whether it learns at all."""

Recipe = AutoEncoderRecipe | TripletRecipe


class TrainingError(OrthonavError, RuntimeError):
    """Learning went wrong: the loss is no longer a number."""


class State:
    """What changes while learning: weights, optimizer, rate, and the losses so far.

    `history` holds the mean loss of each epoch, `losses` those of the batches since.
    """

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
        self.losses: list[Tensor] = []

    def end_epoch(self, loss: float) -> None:
        """Keep the mean loss and lower the rate on a plateau; raises `TrainingError`."""
        if not math.isfinite(loss):
            raise TrainingError(
                f"loss is {loss} in epoch {len(self.history) + 1}: take a smaller learning_rate"
            )
        self.history.append(loss)
        self.losses = []
        if self.plateau is not None:
            self.plateau.step(loss)

    def parts(self) -> dict[str, Any]:
        """All of it, as a checkpoint holds it."""
        return {
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "plateau": self.plateau.state_dict() if self.plateau else None,
            "history": self.history,
            "losses": self.losses,
        }

    def take(self, parts: dict[str, Any]) -> None:
        """Go on from what `parts` gave."""
        self.model.load_state_dict(parts["model"])
        self.optimizer.load_state_dict(parts["optimizer"])
        if self.plateau is not None:
            self.plateau.load_state_dict(parts["plateau"])
        self.history = list(parts["history"])
        self.losses = list(parts.get("losses", []))  # older ones were written after epochs only


class Store:
    """Checkpoints and pictures of one learning in a folder, or nowhere."""

    def __init__(self, work: Path | None, fingerprint: str, every_s: float) -> None:
        self._work, self._fingerprint, self._every_s = work, fingerprint, every_s
        self._saved_s = self._began_s = time.monotonic()
        self._early_s = list(SHOWN_AFTER_S)

    def load(self, state: State, device: torch.device) -> None:
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

    def clear(self) -> None:
        """Remove what kills while writing have left, which may be gigabytes."""
        for left in self._work.glob(".checkpoint.pt.*.tmp.pt") if self._work else ():
            left.unlink(missing_ok=True)

    def after_batch(self, state: State, tiles: SheetTiles) -> None:
        """Write a checkpoint if it is time, and pictures then and early on."""
        now_s = time.monotonic()
        early = bool(self._early_s) and now_s - self._began_s >= self._early_s[0]
        if early:
            self._early_s.pop(0)
        self._write(state, tiles, due=now_s - self._saved_s >= self._every_s, shown=early)

    def after_epoch(self, state: State, tiles: SheetTiles, *, last: bool) -> None:
        """The same after an epoch; always after the last one."""
        due = last or time.monotonic() - self._saved_s >= self._every_s
        self._write(state, tiles, due=due, shown=len(state.history) in SHOWN_EPOCHS)

    def _write(self, state: State, tiles: SheetTiles, *, due: bool, shown: bool) -> None:
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
    """Losses of all epochs (360, 640, 3), logarithmic, with the first, least and last told.

    `unit`: what there is a loss of. Without any, or with one that is no number, there is no curve.
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
    """What must be the same for a checkpoint to be this learning's; `dates` are other sheets."""
    some = np.unique(np.linspace(0, len(tiles) - 1, 64).astype(np.intp))
    where = np.ascontiguousarray(tiles.tiles_px, dtype=np.int64).tobytes()
    learnt = dataclasses.asdict(recipe) | {"precision": "float32"}  # chosen once it is learnt
    told: dict[str, Any] = {
        "recipe": [type(recipe).__name__, learnt],
        "tiles": [zlib.crc32(where), zlib.crc32(tiles.batch(some).tobytes()), tiles.tile_px],
        "seed": seed,
        "means": [means.bf16, means.chunk, world.size],
    }
    if dates:
        told["dates"] = [zlib.crc32(date.batch(some).tobytes()) for date in dates]
    return json.dumps(told, sort_keys=True)
