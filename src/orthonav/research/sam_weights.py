"""Loads Segment Anything weights from Hugging Face folders and from original checkpoints.

The network is that of the `transformers` library. Checkpoints of the segment-anything project hold
the same weights under other names; the shapes of the weights give the size of the network.
"""

import hashlib
import pickle
import re
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from orthonav.core.errors import VariantError
from orthonav.core.extras import missing_extra
from orthonav.research.superpoint import pretrained, quiet, transformers

try:
    import torch
except ImportError as error:
    raise missing_extra("a neural network", "train", "torch", error) from error

WHERE = (
    "the folder of facebook/sam-vit-base, -large or -huge (config.json and model.safetensors) from "
    "the Hugging Face hub, or an original checkpoint such as sam_vit_b_01ec64.pth from "
    "https://dl.fbaipublicfiles.com/segment_anything/"
)


def network(weights: str) -> Any:
    """Network in float32 on the CPU, from a Hugging Face folder or an original checkpoint.

    Raises `VariantError` if the path holds neither.
    """
    path = Path(weights).expanduser()
    return pretrained(weights, "sam", "SamModel") if path.is_dir() else original_model(path)


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


_RENAMES = [
    (re.compile(pattern), name)
    for pattern, name in (
        (r"^image_encoder\.", "vision_encoder."),
        (r"\.patch_embed\.proj\.", ".patch_embed.projection."),
        (r"^vision_encoder\.blocks\.", "vision_encoder.layers."),
        (r"\.neck\.0\.", ".neck.conv1."),
        (r"\.neck\.1\.", ".neck.layer_norm1."),
        (r"\.neck\.2\.", ".neck.conv2."),
        (r"\.neck\.3\.", ".neck.layer_norm2."),
        (
            r"\.pe_layer\.positional_encoding_gaussian_matrix$",
            ".shared_embedding.positional_embedding",
        ),
        (r"\.point_embeddings\.", ".point_embed."),
        (r"\.mask_downscaling\.0\.", ".mask_embed.conv1."),
        (r"\.mask_downscaling\.1\.", ".mask_embed.layer_norm1."),
        (r"\.mask_downscaling\.3\.", ".mask_embed.conv2."),
        (r"\.mask_downscaling\.4\.", ".mask_embed.layer_norm2."),
        (r"\.mask_downscaling\.6\.", ".mask_embed.conv3."),
        (r"\.output_upscaling\.0\.", ".upscale_conv1."),
        (r"\.output_upscaling\.1\.", ".upscale_layer_norm."),
        (r"\.output_upscaling\.3\.", ".upscale_conv2."),
        (r"\.(iou_prediction_head|output_hypernetworks_mlps\.\d+)\.layers\.0\.", r".\1.proj_in."),
        (r"\.(iou_prediction_head|output_hypernetworks_mlps\.\d+)\.layers\.1\.", r".\1.layers.0."),
        (r"\.(iou_prediction_head|output_hypernetworks_mlps\.\d+)\.layers\.2\.", r".\1.proj_out."),
        (r"\.norm(\d|_final_attn)\.", r".layer_norm\1."),
    )
]
_POSITIONS = "prompt_encoder.shared_embedding.positional_embedding"


def converted_weights(original: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Weights of an original checkpoint, renamed as `transformers` expects them."""
    converted = {}
    for key, value in original.items():
        for pattern, name in _RENAMES:
            key = pattern.sub(name, key)
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
