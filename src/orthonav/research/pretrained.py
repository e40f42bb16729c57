"""Pretrained networks from Hugging Face folders, and SuperPoint (DeTone et al., CVPRW 2018).

SuperPoint is the second detector of the bag of words in Di Piazza et al. 2024, section Methodology,
Considered methods. The network is that of the `transformers` library (Apache-2.0). Its weights are
not part of orthonav and it never downloads them: their licence forbids commercial use. They are
published as `magic-leap-community/superpoint` on the Hugging Face hub. This module needs PyTorch.
It never flies.
"""

import importlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError

from orthonav.core.errors import MissingFileError, VariantError
from orthonav.core.extras import missing_extra, needed

try:
    import torch
except ImportError as error:
    raise missing_extra("a neural network", "train", "torch", error) from error

CELL_PX = 8
DIMS = 256
WHERE = (
    "the folder of magic-leap-community/superpoint (config.json and model.safetensors) from the "
    "Hugging Face hub; mind its licence, which forbids commercial use"
)


@dataclass(frozen=True)
class SuperPoint:
    """Keypoints and descriptors of grey pictures.

    Thresholds are those of the folder's config.json.

    - `weights`: path of a Hugging Face folder.
    - `max_points`: largest number of points per picture, the strongest first; 0 for all.
    - `device`: "auto" (a GPU if there is one), "cpu" or "cuda".
    """

    weights: str = ""
    max_points: int = 0
    device: str = "auto"

    def __post_init__(self) -> None:
        if not self.weights:
            raise VariantError(f"superpoint needs weights=PATH: {WHERE}")
        if self.max_points < 0:
            raise VariantError(f"superpoint max_points must be 0 or more, got {self.max_points}")
        require_device(self.device)

    def describe(self, grey: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Points (N, 2) and unit descriptors (N, 256) of a picture (H, W), strongest first.

        A point is (x, y) in pixels from the outer corner of the first pixel, whose centre is
        (0.5, 0.5). A picture without keypoints gives N = 0. Raises `MissingFileError` or
        `VariantError` where the weights are missing or not SuperPoint's.
        """
        device = chosen_device(self.device)
        model = _model(self.weights, weights_stamp(self.weights, WHERE), str(device))
        height, width = grey.shape
        padded = np.pad(grey, ((0, _padding(height)), (0, _padding(width))), mode="edge")
        pixels = torch.from_numpy(padded.astype(np.float32) / np.float32(255)).to(device)
        with torch.inference_mode():
            found = model(pixels[None, None].expand(1, 3, -1, -1))
        size = torch.tensor([padded.shape[1], padded.shape[0]], device=device)
        points = (found.keypoints[0] * size).round().cpu().numpy()
        # The library clears its border on the left and at the top only.
        border = model.config.border_removal_distance
        inside = (points[:, 0] < width - border) & (points[:, 1] < height - border)
        inside &= found.mask[0].cpu().numpy() > 0
        order = np.flatnonzero(inside)
        scores = found.scores[0].cpu().numpy()[order]
        order = order[np.argsort(-scores, kind="stable")][: self.max_points or None]
        descriptors = found.descriptors[0].cpu().numpy()[order]
        return (points[order] + 0.5).astype(np.float32), descriptors.astype(np.float32)


def _padding(size: int) -> int:
    """Padding in pixels up to a multiple of the network's cell, and to two cells at least."""
    return max(-size % CELL_PX, 2 * CELL_PX - size)


@lru_cache(maxsize=1)
def _model(weights: str, stamp: tuple[int, ...], device: str) -> Any:
    del stamp  # part of the key only: files may change
    return pretrained(weights, "superpoint", "SuperPointForKeypointDetection").to(device)


def require_device(device: str) -> None:
    """Raise `VariantError` unless `device` is "auto", "cpu" or "cuda"."""
    if device not in ("auto", "cpu", "cuda"):
        raise VariantError(f"device must be auto, cpu or cuda, got '{device}'")


def chosen_device(device: str) -> torch.device:
    """Device for "auto", "cpu" or "cuda"; raises `VariantError` for "cuda" without a GPU."""
    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise VariantError("device=cuda, but PyTorch sees no GPU; use device=auto or cpu")
    return torch.device("cuda" if device != "cpu" and available else "cpu")


def weights_stamp(weights: str, where: str) -> tuple[int, ...]:
    """Sizes and modification times (ns) of `weights`, a file or a folder: a cache key.

    Raises `MissingFileError` with the source `where` if the path does not exist.
    """
    path = Path(weights).expanduser()
    if not path.exists():
        raise MissingFileError(f"weights not found; use {where}: {path}")
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    stats = [file.stat() for file in files]
    return tuple(value for stat in stats for value in (stat.st_size, stat.st_mtime_ns))


def pretrained(folder: str, model_type: str, class_name: str) -> Any:
    """Model of `transformers` from a Hugging Face folder, in float32 and in evaluation mode.

    Nothing is downloaded, and only safetensors are read. Raises `VariantError` if the folder holds
    another kind of model or lacks some of its weights, which would otherwise be random.
    """
    path = Path(folder).expanduser()
    try:
        config = json.loads((path / "config.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise VariantError(f"not a Hugging Face folder, no readable config.json: {path}") from error
    if not isinstance(config, dict) or config.get("model_type") != model_type:
        raise VariantError(f"expected the weights of a '{model_type}' model: {path}")
    loader = getattr(transformers(), class_name)
    with quiet():
        try:
            model, info = loader.from_pretrained(
                path,
                local_files_only=True,
                use_safetensors=True,
                output_loading_info=True,
                dtype=torch.float32,
            )
        except (OSError, ValueError, RuntimeError, SafetensorError) as error:
            raise VariantError(f"cannot read the weights of {class_name}: {path}") from error
    if lacking := sorted([*info["missing_keys"], *map(str, info["mismatched_keys"])]):
        raise VariantError(f"{len(lacking)} weights are missing, first {lacking[0]}: {path}")
    return model.eval().requires_grad_(False)


def transformers() -> Any:
    return needed("transformers", "train", "a neural network")


@contextmanager
def quiet() -> Iterator[None]:
    """Silence progress bars and warnings of `transformers`; errors are raised instead."""
    logging: Any = importlib.import_module("transformers.utils.logging")
    bars, level = logging.is_progress_bar_enabled(), logging.get_verbosity()
    logging.disable_progress_bar()
    logging.set_verbosity_error()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()
