"""Pretrained networks of the `transformers` library (Apache-2.0), from Hugging Face folders.

Nothing is downloaded: weights are taken by path. This module needs PyTorch and never flies.
"""

import importlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safetensors import SafetensorError

from orthonav.core.errors import MissingFileError, VariantError
from orthonav.core.extras import missing_extra, needed

try:
    import torch
except ImportError as error:
    raise missing_extra("a neural network", "train", "torch", error) from error


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
