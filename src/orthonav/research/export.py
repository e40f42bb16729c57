"""Exports a trained encoder to ONNX, checks it against PyTorch and reduces its precision.

The graph is written layer by layer, with each batch norm folded into the convolution before it. It
holds plain layers only, and the same weights give the same bytes. `torch.onnx.export` without
dynamo does not replace this (PyTorch 2.13): it is deprecated, refuses the adaptive pooling of
features with an odd side (tiles of 32 and 96 px), and names weights by internal counters.
"""

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from orthonav.core.errors import OrthonavError
from orthonav.core.extras import needed
from orthonav.core.tiles.network import AutoEncoderRecipe, NetworkEmbedder, TripletRecipe
from orthonav.research.triplet import BasicBlock, ResNet34

OPSET, IR_VERSION = 17, 8
"""Supported by every onnxruntime since 2022."""
FLOAT_TOLERANCE = 1e-3
"""Largest accepted difference between ONNX and PyTorch, relative to the largest embedding value."""
LEAST_COSINE = {"float32": 0.99999, "float16": 0.9999, "int8": 0.97}
"""Smallest accepted cosine between embeddings in a precision and in PyTorch float32, of every
held-out tile.

float16 halves the file and saves no time: weights are converted back when it is loaded. On
processors without 8-bit products, and in small networks, int8 only reduces the file.
"""
CALIBRATION_BATCH = 8

Array = NDArray[np.float32]


class ExportError(OrthonavError, RuntimeError):
    """The ONNX graph and the PyTorch encoder disagree."""


@dataclass(frozen=True, eq=False)
class Exported:
    embedder: NetworkEmbedder
    precision: str  # "float32" if the recipe's precision was not accurate enough
    cosine: dict[str, float]  # of each precision tried, smallest to the PyTorch embeddings
    least_cosine: float  # required of the recipe's precision
    sizes_mb: dict[str, float]  # of the ONNX model in each precision tried


def export_encoder(
    encoder: nn.Module,
    recipe: AutoEncoderRecipe | TripletRecipe,
    calibration: Array,
    held_out: Array,
    *,
    least_cosine: float | None = None,
) -> Exported:
    """The encoder in the recipe's precision, or in float32 if that precision is too inaccurate.

    The recipe of the embedder, and so the map's manifest, states the precision that was chosen.

    - `encoder`: `AutoEncoder.encoder` or a `ResNet34`.
    - `calibration`: tiles (N, C, S, S) that set the ranges of int8.
    - `held_out`: tiles (N, C, S, S) for the comparison with PyTorch.
    - `least_cosine`: replaces the value of `LEAST_COSINE`.

    Raises `ExportError` if ONNX in float32 and PyTorch disagree,
    `MissingExtraError` without onnx or onnxruntime.
    """
    model = encoder_graph(encoder, held_out.shape[1:])
    plain = _embedder(dataclasses.replace(recipe, precision="float32"), model.SerializeToString())
    random = np.random.default_rng(0).random((2, *held_out.shape[1:]), dtype=np.float32)
    expected = _torch_embeddings(encoder, held_out)
    _require_same(_raw(plain, random), _torch_embeddings(encoder, random), "random numbers")
    _require_same(_raw(plain, held_out), expected, "tiles")
    tried = {"float32": plain}
    if recipe.precision != "float32":
        smaller = int8(model, calibration) if recipe.precision == "int8" else float16(model)
        tried[recipe.precision] = _embedder(recipe, smaller)
    cosine = {
        name: least_cosine_between(_raw(each, held_out), expected) for name, each in tried.items()
    }
    sizes = {name: each.onnx.nbytes / 1e6 for name, each in tried.items()}
    enough = LEAST_COSINE[recipe.precision] if least_cosine is None else least_cosine
    chosen = recipe.precision if cosine[recipe.precision] >= enough else "float32"
    return Exported(tried[chosen], chosen, cosine, enough, sizes)


def least_cosine_between(first: Array, second: Array) -> float:
    """Smallest cosine between embeddings (N, D) of the same tiles; 1 for two zero vectors."""
    norms = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    products = np.einsum("nd,nd->n", first, second)
    both_zero = np.maximum(np.abs(first).max(axis=1), np.abs(second).max(axis=1)) == 0
    return float(np.where(both_zero, 1, products / np.maximum(norms, 1e-30)).min())


def encoder_graph(encoder: nn.Module, shape: tuple[int, ...]) -> Any:
    """ONNX model of an encoder: "maps" (N, *shape) to "embedding" (N, D), N free.

    Raises `TypeError` for anything but a `ResNet34` or a sequence of known layers.
    """
    graph = _Graph()
    if isinstance(encoder, ResNet34):
        value = graph.sequence(encoder.stem, "maps")
        for block in encoder.blocks:
            value = graph.block(block, value)
        value = graph.halves(value, -(-shape[-1] // 32))
    elif isinstance(encoder, nn.Sequential):
        value = graph.sequence(encoder, "maps")
    else:
        raise TypeError(f"this encoder cannot be exported: {type(encoder).__name__}")
    dims = _torch_embeddings(encoder, np.zeros((1, *shape), np.float32)).shape[1]
    return graph.model(value, shape, dims)


def int8(model: Any, calibration: Array) -> bytes:
    """The model with 8-bit weights and activations, ranges from calibration tiles (N, C, S, S)."""
    from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static

    class Tiles(CalibrationDataReader):  # type: ignore[misc]  # untyped
        def __init__(self) -> None:
            starts = range(0, len(calibration), CALIBRATION_BATCH)
            self._parts = iter([calibration[at : at + CALIBRATION_BATCH] for at in starts])

        def get_next(self) -> dict[str, Array] | None:
            part = next(self._parts, None)
            return None if part is None else {"maps": part}

    # Marks the graph as preprocessed, so that onnxruntime does not log advice to do so.
    marked = type(model)()
    marked.CopyFrom(model)
    marked.metadata_props.add(key="onnx.quant.pre_process", value="onnxruntime.quant")
    with tempfile.TemporaryDirectory(prefix="orthonav-int8-") as folder:
        source, target = Path(folder) / "float.onnx", Path(folder) / "int8.onnx"
        source.write_bytes(marked.SerializeToString())
        quantize_static(
            str(source),
            str(target),
            Tiles(),
            per_channel=True,
            # 7 bits for weights: sums of 8-bit ones overflow on processors without VNNI.
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
        return target.read_bytes()


def float16(model: Any) -> bytes:
    """The model with weights in 16 bits, converted to 32 when it is loaded."""
    import onnx

    float32 = onnx.TensorProto.FLOAT
    small = onnx.ModelProto()
    small.CopyFrom(model)
    casts = []
    for weights in small.graph.initializer:
        values = onnx.numpy_helper.to_array(weights)
        if values.ndim < 2 or np.abs(values).max() > np.finfo(np.float16).max:
            continue
        name = weights.name
        halved = onnx.numpy_helper.from_array(values.astype(np.float16), f"{name}_16")
        weights.CopyFrom(halved)
        casts.append(onnx.helper.make_node("Cast", [halved.name], [name], to=float32))
    nodes = [*casts, *small.graph.node]
    del small.graph.node[:]
    small.graph.node.extend(nodes)
    return bytes(small.SerializeToString())


class _Graph:
    """ONNX graph under construction; each method returns the name of the value it adds."""

    def __init__(self) -> None:
        self._onnx = needed("onnx", "train", "exporting an encoder")
        self._nodes: list[Any] = []
        self._weights: list[Any] = []

    def sequence(self, layers: nn.Sequential, value: str) -> str:
        """Layers in sequence, each batch norm folded into the convolution before it."""
        modules = list(layers)
        for at, module in enumerate(modules):
            following = modules[at + 1] if at + 1 < len(modules) else None
            if isinstance(module, nn.Conv2d):
                norm = following if isinstance(following, nn.BatchNorm2d) else None
                value = self.convolution(module, norm, value)
            elif not isinstance(module, nn.BatchNorm2d):
                value = self.plain(module, value)
        return value

    def block(self, block: nn.Module, value: str) -> str:
        if not isinstance(block, BasicBlock):
            raise TypeError(f"this block cannot be exported: {type(block).__name__}")
        shortcut = value if block.short_cut is None else self.sequence(block.short_cut, value)
        value = self.convolution(block.first, block.first_norm, value)
        value = self.convolution(block.second, block.second_norm, self._node("Relu", [value]))
        return self._node("Relu", [self._node("Add", [value, shortcut])])

    def convolution(self, layer: nn.Conv2d, norm: nn.BatchNorm2d | None, value: str) -> str:
        weights = layer.weight.detach().double().cpu()
        bias = torch.zeros(layer.out_channels, dtype=torch.float64)
        if layer.bias is not None:
            bias = layer.bias.detach().double().cpu()
        if norm is not None and norm.running_mean is not None and norm.running_var is not None:
            gain = norm.weight.detach().double() / torch.sqrt(norm.running_var.double() + norm.eps)
            shift = norm.bias.detach().double() - norm.running_mean.double() * gain
            weights = weights * gain.cpu()[:, None, None, None]
            bias = bias * gain.cpu() + shift.cpu()
        return self._node(
            "Conv",
            [value, self._weight(weights), self._weight(bias)],
            kernel_shape=list(layer.kernel_size),
            strides=list(layer.stride),
            pads=[int(pad) for pad in layer.padding] * 2,
        )

    def plain(self, module: nn.Module, value: str) -> str:
        match module:
            case nn.LeakyReLU():
                return self._node("LeakyRelu", [value], alpha=float(module.negative_slope))
            case nn.ReLU():
                return self._node("Relu", [value])
            case nn.Flatten():
                return self._node("Flatten", [value], axis=1)
            case nn.Linear():
                names = [self._weight(module.weight), self._weight(module.bias)]
                return self._node("Gemm", [value, *names], transB=1)
            case nn.MaxPool2d(
                kernel_size=int() as size, stride=int() as step, padding=int() as pad
            ):
                return self._node(
                    "MaxPool",
                    [value],
                    kernel_shape=[size, size],
                    strides=[step, step],
                    pads=[pad] * 4,
                )
        raise TypeError(f"this layer cannot be exported: {type(module).__name__}")

    def halves(self, value: str, side_px: int) -> str:
        """Means over the left and the right half of square features, channel by channel."""
        if side_px == 1:
            mean = self._node("GlobalAveragePool", [value])
            pooled = self._node("Concat", [mean, mean], axis=3)
        else:
            # If the side is odd, both halves include the middle column.
            pooled = self._node(
                "AveragePool",
                [value],
                kernel_shape=[side_px, (side_px + 1) // 2],
                strides=[side_px, side_px // 2],
            )
        return self._node("Flatten", [pooled], axis=1)

    def model(self, value: str, shape: tuple[int, ...], dims: int) -> Any:
        """The finished model, whose output is `value`."""
        helper, kind = self._onnx.helper, self._onnx.TensorProto.FLOAT
        self._nodes[-1].output[0] = "embedding"
        graph = helper.make_graph(
            self._nodes,
            "encoder",
            [helper.make_tensor_value_info("maps", kind, ["N", *shape])],
            [helper.make_tensor_value_info("embedding", kind, ["N", dims])],
            self._weights,
        )
        opset = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opset, producer_name="orthonav")
        model.ir_version = IR_VERSION
        self._onnx.checker.check_model(model)
        return model

    def _node(self, operator: str, inputs: list[str], **attributes: Any) -> str:
        name = f"v{len(self._nodes)}"
        self._nodes.append(self._onnx.helper.make_node(operator, inputs, [name], **attributes))
        return name

    def _weight(self, values: torch.Tensor) -> str:
        name = f"w{len(self._weights)}"
        array = values.detach().float().cpu().contiguous().numpy()
        self._weights.append(self._onnx.numpy_helper.from_array(array, name))
        return name


def _embedder(recipe: AutoEncoderRecipe | TripletRecipe, data: bytes) -> NetworkEmbedder:
    return NetworkEmbedder(recipe, np.frombuffer(data, dtype=np.uint8))


def _raw(embedder: NetworkEmbedder, maps: Array) -> Array:
    """Output of the graph, not scaled to length 1."""
    recipe = dataclasses.replace(embedder.recipe, similarity="product")
    return NetworkEmbedder(recipe, embedder.onnx).views(maps)


def _torch_embeddings(encoder: nn.Module, maps: Array) -> Array:
    """Embeddings (N, D) in float32 from PyTorch in evaluation mode."""
    device = next(encoder.parameters()).device
    was_training = encoder.training
    encoder.eval()
    with torch.no_grad():
        parts = [
            encoder(torch.from_numpy(maps[at : at + CALIBRATION_BATCH]).to(device)).float().cpu()
            for at in range(0, len(maps), CALIBRATION_BATCH)
        ]
    encoder.train(was_training)
    return np.asarray(torch.cat(parts).numpy())


def _require_same(exported: Array, expected: Array, what: str) -> None:
    difference = float(np.abs(exported - expected).max())
    largest = float(np.abs(expected).max())
    if not difference <= FLOAT_TOLERANCE * max(largest, 1e-6):
        raise ExportError(
            f"ONNX and PyTorch disagree on {what}: difference {difference:g}, largest value "
            f"{largest:g}"
        )
