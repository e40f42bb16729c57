"""Edges by a network from a file: `onnx:weights=PATH`.

It takes "grey" (1, 1, H + 2 m, W + 2 m) float32, 0 to 1 with a margin of m pixels, and gives
"edges" (1, 1, H, W), positive on an edge, as that of `experiments/paper/between_dates.onnx`. A
map stores its SHA-256, and flies with that network only."""

import hashlib
import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import VariantError
from orthonav.core.extras import needed
from orthonav.core.files import require_file
from orthonav.core.tiles.network import session_of
from orthonav.core.tiles.represent import filled, inner

VARIABLE = "ORTHONAV_EDGES"
MAX_BYTES = 64 << 20  # larger networks are not meant for an aircraft


@dataclass(frozen=True)
class LearnedEdges:
    """Binary edges of a network in an ONNX file.

    `weights`: by default ORTHONAV_EDGES; maps store only `sha256`. Raises `MissingFileError`,
    `MissingExtraError` without onnxruntime, `VariantError` for another digest or no such network.
    """

    weights: str = ""
    sha256: str = ""

    def __post_init__(self) -> None:
        if not self.path:
            raise VariantError(
                f"onnx edges need a network: give --edges onnx:weights=PATH, or set {VARIABLE}"
            )
        if not self.sha256:
            object.__setattr__(self, "sha256", hashlib.sha256(_read(self.path)).hexdigest())
        _network(self.path, self.sha256)  # fails here, not at the first view

    @property
    def path(self) -> str:
        return self.weights or os.environ.get(VARIABLE, "")

    channels = 1

    @property
    def margin_px(self) -> int:
        return _network(self.path, self.sha256)[1]

    def __call__(self, grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        """1 on an edge, else 0; none along the border of `valid`."""
        out = np.zeros((1, *grey.shape), np.float32)
        if not valid.any():
            return out
        session, margin = _network(self.path, self.sha256)
        levels = filled(grey, valid).astype(np.float32) / 255
        edges = _run(session, np.pad(levels, margin, mode="edge")) > 0
        out[0] = edges & inner(valid, 2 * margin + 1)
        return out


def _read(path: str) -> bytes:
    with require_file(Path(path), "edge network").open("rb") as stream:
        data = stream.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise VariantError(f"edge network is larger than {MAX_BYTES >> 20} MiB: {path}")
    return data


@lru_cache(maxsize=4)
def _network(path: str, sha256: str) -> tuple[Any, int]:
    """Session and margin in pixels; one session serves all threads."""
    data = _read(path)
    found = hashlib.sha256(data).hexdigest()
    if found != sha256:
        raise VariantError(
            f"map was made with another edge network (SHA-256 {sha256[:12]}, this has "
            f"{found[:12]}); give the one it was made with: {path}"
        )
    runtime = needed("onnxruntime", "neural", "edges by a network")
    probe_px, max_margin_px = 96, 32
    try:
        session = session_of(runtime, data)
        shape = _run(session, np.zeros((probe_px, probe_px + 2), np.float32)).shape
    except Exception as error:
        # Its errors have no common class below Exception.
        raise VariantError(
            f'no network from "grey" (1, 1, H, W) to "edges", float32: {path} ({error})'
        ) from error
    margin, odd = divmod(probe_px - shape[-1] + 2, 2) if len(shape) == 2 else (-1, 0)
    if odd or shape != (probe_px - 2 * margin, probe_px + 2 - 2 * margin):
        raise VariantError(
            f"edges must be as large as the grey levels less the same margin on each side, got "
            f"{shape} of {(probe_px, probe_px + 2)}: {path}"
        )
    if not 0 <= margin <= max_margin_px:
        raise VariantError(
            f"edges must have a margin of 0 to {max_margin_px} px, got {margin}: {path}"
        )
    return session, margin


def _run(session: Any, levels: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) of grey levels (H, W), where it gives one channel."""
    found = session.run(["edges"], {"grey": levels[None, None]})[0]
    return np.asarray(found[0, 0] if found.ndim == 4 and found.shape[:2] == (1, 1) else found)
