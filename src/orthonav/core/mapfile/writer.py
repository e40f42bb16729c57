"""Writing a map: one safetensors file, complete or not at all, deterministic to the byte."""

import dataclasses
import errno
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import save_file

from orthonav.core.errors import OutputError
from orthonav.core.files import replacing
from orthonav.core.mapfile.manifest import Manifest

METADATA_KEY = "orthonav"


def write_map(path: Path, manifest: Manifest, arrays: Mapping[str, NDArray[Any]]) -> Manifest:
    """The manifest with its `parts` filled in. Raises `OutputError` and leaves nothing behind."""
    parts = {name: np.ascontiguousarray(array) for name, array in sorted(arrays.items())}
    described = {
        name: {
            "dtype": str(array.dtype),
            "shape": list(array.shape),
            "sha256": hashlib.sha256(array.data).hexdigest(),
        }
        for name, array in parts.items()
    }
    full = dataclasses.replace(manifest, parts=described)
    save_tensors(path, parts, full.to_json(), "map")
    return full


def save_tensors(path: Path, arrays: Mapping[str, NDArray[Any]], metadata: str, what: str) -> None:
    """Complete or not at all; raises `OutputError`, which names `what`."""
    with replacing(path) as temporary:
        try:
            contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
            save_file(contiguous, temporary, metadata={METADATA_KEY: metadata})
        except SafetensorError as error:
            if f"os error {errno.ENOSPC}" in str(error):
                raise OSError(errno.ENOSPC, "disk full") from error
            raise OutputError(f"{what} cannot be written ({error}): {path}") from error
