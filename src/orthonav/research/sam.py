"""Boundaries of Segment Anything masks (Kirillov et al., ICCV 2023) as binary edge maps.

"We apply SAM to each image to obtain a segmentation masks, which are then transformed into binary
maps containing all the segmentation boundaries"; Base does as well as Large and Huge (Di Piazza et
al. 2024, section Methodology). It leaves the generator of masks open; here it is the automatic one
of Kirillov et al., appendix B: a grid of points prompts the network, which returns three masks
each. Masks with a low expected IoU or a low stability are dropped, then near duplicates. The
network is that of the `transformers` library (Apache-2.0); its weights are given by path and never
downloaded. This module needs PyTorch and seconds to minutes per picture; it never flies.
"""

import hashlib
import itertools
import logging
import os
import pickle
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import OutputError, VariantError
from orthonav.core.extras import missing_extra
from orthonav.core.files import replacing
from orthonav.core.tiles.represent import Grey, Mask, filled, inner
from orthonav.core.variants import Checked, choice, within
from orthonav.research.pretrained import (
    chosen_device,
    pretrained,
    quiet,
    transformers,
    weights_stamp,
)

try:
    import torch
except ImportError as error:
    raise missing_extra("a neural network", "train", "torch", error) from error

log = logging.getLogger(__name__)

WHERE = (
    "the folder of facebook/sam-vit-base, -large or -huge (config.json and model.safetensors) from "
    "the Hugging Face hub, or an original checkpoint such as sam_vit_b_01ec64.pth from "
    "https://dl.fbaipublicfiles.com/segment_anything/"
)

PRECISIONS = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}
CACHE_FORMAT = b"orthonav sam boundaries 2"
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, as in training
_CHUNK_PIXELS = {"cpu": 1 << 20, "cuda": 1 << 24}
"""Pixels of masks scaled at once. On a CPU, small chunks reuse memory of the process: 0.57 s per
window against 1.18 s at 1 << 24 (small network)."""

WEIGHTS_VARIABLE = "ORTHONAV_SAM_WEIGHTS"
Predict = Callable[[NDArray[np.float32]], tuple[torch.Tensor, torch.Tensor]]
"""Points (P, 2), x and y in pixels of the network, to logits (P, 3, h, w) and IoU (P, 3)."""


@dataclass(frozen=True)
class SamBoundaries(Checked):
    """Binary map of the boundaries of all automatic Segment Anything masks of a picture.

    Defaults of `grid`, `iou`, `stability`, `offset` and `overlap` are those of the original
    generator. Larger pictures are cut into windows, so that point spacing and magnification are
    those of a tile. `per`: "sheet": a sheet is segmented once and tiles are cut out of its
    boundaries; "tile": every reference tile is segmented by itself, as a view is and as in the
    paper, some 64 times the work at an overlap of 87.5 %.
    """

    weights: str = ""  # Hugging Face folder or original checkpoint; else ORTHONAV_SAM_WEIGHTS
    grid: int = within(32, 1, 256)  # points along one side of a window
    iou: float = within(0.88, 0, 1)  # least IoU with the truth that is expected of a mask
    stability: float = within(0.95, 0, 1)  # least IoU of the masks cut at logits +-`offset`
    offset: float = within(1.0, 0, above=True)
    overlap: float = within(0.7, 0, 1)  # IoU of boxes above which the less expected is dropped
    window: int = 256  # side of the windows, 16 to 4096 px; 0: none
    per: str = choice("sheet", "tile")
    prompts: int = within(64, 1, 4096)  # points per call of the network
    device: str = choice("auto", "cpu", "cuda")
    precision: str = choice(*PRECISIONS)  # of the two transformers
    cache: str = ""  # folder of finished windows or "none"; else ORTHONAV_CACHE or the user's

    def __post_init__(self) -> None:
        if not self.path:
            raise VariantError(f"sam needs weights=PATH, or {WEIGHTS_VARIABLE}: {WHERE}")
        super().__post_init__()
        if self.window and not 16 <= self.window <= 4096:
            raise VariantError(f"window must be 0 or 16 to 4096 px, got {self.window}")

    @property
    def path(self) -> str:
        """Of the weights. Maps do not store it: it is one of the machine that built them."""
        return self.weights or os.environ.get(WEIGHTS_VARIABLE, "")

    channels = 1

    margin_px = 0  # a mask depends on the whole window, and no margin would change that

    def __call__(self, grey: Grey, valid: Mask) -> NDArray[np.float32]:
        """Boundaries (1, H, W), 1 on a boundary, else 0; none along the border of `valid`.

        Values of invalid pixels have no influence. Raises `MissingFileError` or
        `VariantError` where the weights are missing or not Segment Anything's.
        """
        out = np.zeros((1, *grey.shape), dtype=np.float32)
        for part in _windows(grey.shape, self.window):
            if valid[part].any():
                out[0][part] = np.maximum(out[0][part], self._window(grey[part], valid[part]))
        out[0] *= inner(valid, 5)
        return out

    def _window(self, grey: Grey, valid: Mask) -> Mask:
        """Boundaries (H, W) of one window, from the cache where it is there."""
        grey = filled(grey, valid)
        stamp = weights_stamp(self.path, WHERE)
        folder = _cache_folder(self.cache)
        path = folder / f"{self._key(grey, stamp)}.edges" if folder else None
        edges = _cached(path, grey.shape) if path else None
        if edges is None:
            device = chosen_device(self.device)
            model = _model(self.path, stamp, str(device))
            predict = _predictor(model, grey, PRECISIONS[self.precision])
            side = int(model.config.vision_config.image_size)
            edges = boundary_map(automatic_masks(predict, grey.shape, side, self), grey.shape)
            if path:
                _keep(path, edges)
        return edges

    def _key(self, grey: Grey, stamp: tuple[int, ...]) -> str:
        """Cache key of a window: digest of its pixels, the weights and the settings."""
        rules = (self.grid, self.iou, self.stability, self.offset, self.overlap, self.precision)
        digest = hashlib.sha256(CACHE_FORMAT)
        digest.update(repr((grey.shape, rules, weights_digest(self.path, stamp))).encode())
        digest.update(grey.tobytes())
        return digest.hexdigest()


def _windows(shape: tuple[int, ...], window: int) -> Iterator[tuple[slice, slice]]:
    """Evenly spaced windows of at most `window` px that cover a picture (H, W)."""
    sides = []
    for size in shape:
        length = min(size, window or size)
        starts = np.linspace(0, size - length, -(-size // length)).round().astype(int)
        sides.append([slice(int(start), int(start) + length) for start in starts])
    yield from itertools.product(*sides)


Box = tuple[NDArray[np.uint8], NDArray[np.int64], float]
"""An accepted mask: bits of (H, W), corners (x0, y0, x1, y1) of its pixels, expected IoU."""


def automatic_masks(
    predict: Predict, shape: tuple[int, ...], side: int, rules: SamBoundaries
) -> Iterator[Mask]:
    """Accepted masks (H, W) of a grid of points, highest expected IoU first.

    `side` is the side of the network's square input in pixels; the longer side of the picture is
    scaled to it.
    """
    height, width = shape
    centres = (np.arange(rules.grid) + 0.5) / rules.grid
    x, y = np.meshgrid(centres, centres)
    resized = _resized_shape(shape, side)
    points = np.stack([x.ravel() * resized[1], y.ravel() * resized[0]], axis=1).astype(np.float32)
    found: list[Box] = []
    for start in range(0, len(points), rules.prompts):
        logits, iou = predict(points[start : start + rules.prompts])
        found += _trusted(logits.flatten(0, 1), iou.flatten(), shape, side, rules)
    if not found:
        return
    packed, corners, ious = zip(*found, strict=True)
    for index in suppressed(np.stack(corners), np.array(ious), rules.overlap):
        bits = np.unpackbits(packed[index], count=height * width)
        yield bits.reshape(height, width).astype(bool)


def _trusted(
    logits: torch.Tensor, iou: torch.Tensor, shape: tuple[int, ...], side: int, rules: SamBoundaries
) -> Iterator[Box]:
    """Masks (M, h, w) whose expected IoU (M,) and stability reach the limits of `rules`."""
    good = iou > rules.iou
    logits, iou = logits[good], iou[good]
    resized = _resized_shape(shape, side)
    pixels = _CHUNK_PIXELS.get(logits.device.type, _CHUNK_PIXELS["cpu"])
    chunk = max(1, pixels // max(side * side, shape[0] * shape[1]))
    for start in range(0, len(logits), chunk):
        part = logits[start : start + chunk, None].float()
        part = _scaled(part, (side, side))[..., : resized[0], : resized[1]]
        full = _scaled(part, (shape[0], shape[1]))[:, 0]
        inner = (full > rules.offset).sum(dim=(1, 2))
        outer = (full > -rules.offset).sum(dim=(1, 2))
        stable = (inner >= rules.stability * outer) & (outer > 0)
        masks = (full[stable] > 0).cpu().numpy()
        for mask, trust in zip(masks, iou[start : start + chunk][stable].tolist(), strict=True):
            if mask.any():
                x, y = (np.flatnonzero(mask.any(axis=axis)) for axis in (0, 1))
                yield np.packbits(mask), np.array([x[0], y[0], x[-1], y[-1]]), trust


def _scaled(logits: torch.Tensor, shape: tuple[int, int]) -> torch.Tensor:
    return torch.nn.functional.interpolate(logits, shape, mode="bilinear", align_corners=False)


def suppressed(
    corners: NDArray[np.int64], scores: NDArray[np.floating[Any]], overlap: float
) -> list[int]:
    """Indices of boxes after non-maximum suppression, best score first.

    `corners` (N, 4) are x0, y0, x1, y1. A box is dropped if its IoU with a better accepted box is
    above `overlap`. As in the original generator, a box reaches from the index of its first pixel
    to that of its last, so a box one pixel wide has no area and is never dropped.
    """
    order = np.argsort(-scores, kind="stable")
    areas = (corners[:, 2:] - corners[:, :2]).prod(axis=1)
    accepted = []
    while len(order):
        best, order = order[0], order[1:]
        accepted.append(int(best))
        first = np.maximum(corners[best, :2], corners[order, :2])
        last = np.minimum(corners[best, 2:], corners[order, 2:])
        common = (last - first).clip(min=0).prod(axis=1)
        union = areas[best] + areas[order] - common
        order = order[common <= overlap * union]
    return accepted


def boundary_map(masks: Iterable[Mask], shape: tuple[int, ...]) -> Mask:
    """Pixels (H, W) of any mask that touch a pixel outside it within the picture."""
    edges = np.zeros(shape, dtype=bool)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    for mask in masks:
        inside = cv2.erode(mask.astype(np.uint8), cross, borderValue=1).reshape(shape)
        edges |= mask & (inside == 0)
    return edges


def _resized_shape(shape: tuple[int, ...], side: int) -> tuple[int, int]:
    """Height and width of a picture (H, W) with its longer side as long as the network's."""
    height, width = (max(1, int(size * side / max(shape) + 0.5)) for size in shape)
    return height, width


def network_pixels(grey: Grey, side: int) -> torch.Tensor:
    """Network input (1, 3, side, side) for a grey picture (H, W), padded with zeros."""
    height, width = _resized_shape(grey.shape, side)
    pixels = torch.from_numpy(np.array(grey, dtype=np.float32))[None, None]
    pixels = torch.nn.functional.interpolate(
        pixels, (height, width), mode="bilinear", align_corners=False, antialias=True
    )
    mean, deviation = (torch.tensor(values).reshape(3, 1, 1) for values in (_MEAN, _DEVIATION))
    pixels = (pixels.round().clamp(0, 255) / 255 - mean) / deviation
    return torch.nn.functional.pad(pixels, (0, side - width, 0, side - height))


def _predictor(model: Any, grey: Grey, dtype: torch.dtype) -> Predict:
    """Function that prompts the network with points of one picture, encoded once.

    Positions are always encoded in float32: half precision would lose their phases.
    """
    device = model.device
    half = torch.autocast(device.type, dtype, enabled=dtype != torch.float32)
    pixels = network_pixels(grey, int(model.config.vision_config.image_size)).to(device)
    with torch.inference_mode():
        with half:
            encoded = model.get_image_embeddings(pixels).float()
        places = model.get_image_wide_positional_embeddings()

    def predict(points: NDArray[np.float32]) -> tuple[torch.Tensor, torch.Tensor]:
        prompt = torch.from_numpy(points).to(device)[None, :, None]
        labels = torch.ones(prompt.shape[:-1], dtype=torch.int, device=device)
        with torch.inference_mode():
            sparse, dense = model.prompt_encoder(prompt, labels, None, None)
            with half:
                logits, iou = model.mask_decoder(encoded, places, sparse, dense, True)
        return logits[0], iou[0].float()

    return predict


@lru_cache(maxsize=1)
def _model(weights: str, stamp: tuple[int, ...], device: str) -> Any:
    """Network in float32, from a Hugging Face folder or an original checkpoint."""
    del stamp  # part of the key only: files may change
    path = Path(weights).expanduser()
    found = pretrained(weights, "sam", "SamModel") if path.is_dir() else original_model(path)
    return found.to(device)


def _cache_folder(cache: str) -> Path | None:
    """Folder of entries: `cache`, ORTHONAV_CACHE or the user's cache folder; None for "none"."""
    if cache == "none":
        return None
    users = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    own = os.environ.get("ORTHONAV_CACHE") or f"{users}/orthonav"
    return Path(cache or f"{own}/sam").expanduser()


def _cached(path: Path, shape: tuple[int, ...]) -> Mask | None:
    """Edge map (H, W) of a cache entry, compressed bits; None if it is absent or damaged."""
    try:
        bits = np.unpackbits(np.frombuffer(zlib.decompress(path.read_bytes()), np.uint8))
        return bits[: shape[0] * shape[1]].reshape(shape).astype(bool)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, zlib.error) as error:
        log.warning("unreadable cache entry; computing it again (%s): %s", error, path)
        return None


def _keep(path: Path, edges: Mask) -> None:
    """Write a cache entry; if that fails, log a warning and go on without it."""
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(zlib.compress(np.packbits(edges).tobytes()))
    except OutputError as error:
        log.warning("could not write the cache entry: %s", error)


@lru_cache(maxsize=8)
def weights_digest(weights: str, stamp: tuple[int, ...]) -> str:
    """SHA-256 of the weights file, or of the config and weights of a folder."""
    del stamp  # part of the key only: files may change
    path = Path(weights).expanduser()
    files = [path]
    if path.is_dir():
        files = sorted([*path.glob("config.json"), *path.glob("*.safetensors")])
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


_HEADS = r"\.(iou_prediction_head|output_hypernetworks_mlps\.\d+)\.layers"
_RENAMES = {  # patterns of original names, and what replaces them, in this order
    r"^image_encoder\.": "vision_encoder.",
    r"\.patch_embed\.proj\.": ".patch_embed.projection.",
    r"^vision_encoder\.blocks\.": "vision_encoder.layers.",
    r"\.neck\.0\.": ".neck.conv1.",
    r"\.neck\.1\.": ".neck.layer_norm1.",
    r"\.neck\.2\.": ".neck.conv2.",
    r"\.neck\.3\.": ".neck.layer_norm2.",
    r"\.pe_layer\.positional_encoding_gaussian_matrix$": ".shared_embedding.positional_embedding",
    r"\.point_embeddings\.": ".point_embed.",
    r"\.mask_downscaling\.0\.": ".mask_embed.conv1.",
    r"\.mask_downscaling\.1\.": ".mask_embed.layer_norm1.",
    r"\.mask_downscaling\.3\.": ".mask_embed.conv2.",
    r"\.mask_downscaling\.4\.": ".mask_embed.layer_norm2.",
    r"\.mask_downscaling\.6\.": ".mask_embed.conv3.",
    r"\.output_upscaling\.0\.": ".upscale_conv1.",
    r"\.output_upscaling\.1\.": ".upscale_layer_norm.",
    r"\.output_upscaling\.3\.": ".upscale_conv2.",
    rf"{_HEADS}\.0\.": r".\1.proj_in.",
    rf"{_HEADS}\.1\.": r".\1.layers.0.",
    rf"{_HEADS}\.2\.": r".\1.proj_out.",
    r"\.norm(\d|_final_attn)\.": r".layer_norm\1.",
}
_POSITIONS = "prompt_encoder.shared_embedding.positional_embedding"


def converted_weights(original: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Weights of an original checkpoint, renamed as `transformers` expects them."""
    converted = {}
    for key, value in original.items():
        for pattern, name in _RENAMES.items():
            key = re.sub(pattern, name, key)
        converted[key] = value
    converted["shared_image_embedding.positional_embedding"] = converted[_POSITIONS]
    return converted


def original_model(path: Path) -> Any:
    """Network of an original checkpoint such as `sam_vit_b_01ec64.pth`, in float32.

    The shapes of the weights give its size. Raises `VariantError` for any other file.
    """
    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise VariantError(f"cannot read the weights; expected {WHERE}: {path}") from error
    try:
        # Some files also hold the constants that normalize pictures.
        named = {k: v for k, v in weights.items() if k not in ("pixel_mean", "pixel_std")}
        with quiet():
            model = transformers().SamModel(_config(named))
        model.load_state_dict(converted_weights(named))
    except (KeyError, AttributeError, TypeError, ValueError, IndexError, RuntimeError) as error:
        raise VariantError(f"not Segment Anything weights; expected {WHERE}: {path}") from error
    return model.eval().requires_grad_(False)


def _config(original: Mapping[str, torch.Tensor]) -> Any:
    """`SamConfig` derived from the shapes of an original checkpoint."""
    library = transformers()
    shapes = {key: tuple(value.shape) for key, value in original.items()}
    hidden, colours, patch, _ = shapes["image_encoder.patch_embed.proj.weight"]
    grid = shapes["image_encoder.pos_embed"][1]
    depth = _count(shapes, r"image_encoder\.blocks\.(\d+)\.norm1\.weight")
    reaches, head = zip(
        *(shapes[f"image_encoder.blocks.{i}.attn.rel_pos_h"] for i in range(depth)), strict=True
    )
    windows = [(reach + 1) // 2 for reach in reaches]  # of 2 * window - 1 relative positions
    vision = library.SamVisionConfig(
        hidden_size=hidden,
        output_channels=shapes["image_encoder.neck.0.weight"][0],
        num_hidden_layers=depth,
        num_attention_heads=hidden // head[0],
        num_channels=colours,
        image_size=grid * patch,
        patch_size=patch,
        window_size=min(windows) if min(windows) < grid else 14,
        global_attn_indexes=[i for i, window in enumerate(windows) if window == grid],
        num_pos_feats=shapes["prompt_encoder.pe_layer.positional_encoding_gaussian_matrix"][1],
        mlp_dim=shapes["image_encoder.blocks.0.mlp.lin1.weight"][0],
    )
    tokens, decoded = shapes["mask_decoder.mask_tokens.weight"]
    prompt = library.SamPromptEncoderConfig(
        hidden_size=decoded,
        image_size=grid * patch,
        patch_size=patch,
        mask_input_channels=shapes["prompt_encoder.mask_downscaling.3.weight"][0],
        num_point_embeddings=_count(shapes, r"prompt_encoder\.point_embeddings\.(\d+)\.weight"),
    )
    layers = "mask_decoder.transformer.layers"
    decoder = library.SamMaskDecoderConfig(
        hidden_size=decoded,
        mlp_dim=shapes[f"{layers}.0.mlp.lin1.weight"][0],
        num_hidden_layers=_count(shapes, layers.replace(".", r"\.") + r"\.(\d+)\.norm1\.weight"),
        attention_downsample_rate=decoded
        // shapes[f"{layers}.0.cross_attn_token_to_image.q_proj.weight"][0],
        num_multimask_outputs=tokens - 1,
        iou_head_hidden_dim=shapes["mask_decoder.iou_prediction_head.layers.0.weight"][0],
    )
    return library.SamConfig(
        vision_config=vision, prompt_encoder_config=prompt, mask_decoder_config=decoder
    )


def _count(keys: Iterable[str], pattern: str) -> int:
    return sum(re.fullmatch(pattern, key) is not None for key in keys)
