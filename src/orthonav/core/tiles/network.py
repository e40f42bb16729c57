"""Neural encoders as they fly: an ONNX graph in the map, run by onnxruntime, without PyTorch.

"Only the embeddings of the reference images E(I) and encoder weights are stored on board the UAV"
(Di Piazza et al. 2024, section Related work, Auto-Encoder); `orthonav.research` learns them."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError
from orthonav.core.extras import needed
from orthonav.core.variants import Checked, Part, choice, require_fits, within

OPERATORS = frozenset(
    [
        "Add",
        "AveragePool",
        "Cast",
        "Concat",
        "Conv",
        "DequantizeLinear",
        "Flatten",
        "Gemm",
        "GlobalAveragePool",
        "Identity",
        "LeakyRelu",
        "MaxPool",
        "QuantizeLinear",
        "Relu",
    ]
)
"""Nothing that loops, branches, reads files or makes big arrays."""


@dataclass(frozen=True)
class AutoEncoderRecipe(Checked):
    """Parameters of the auto-encoder; defaults are the paper's (section Methodology).

    `width`: channels before its dense layer, a multiple of 8. `epochs`, `batch`, `learning_rate`:
    of AdamW. `similarity`: "product" (the paper) or "cosine". `precision`: "float32", "float16"
    (weights only) or "int8"."""

    dims: int = within(1024, 1, 4096)
    width: int = within(512, 8, 1024)
    epochs: int = within(200, 1, 100_000)
    batch: int = within(32, 1, 65_536)
    learning_rate: float = within(3e-4, 0, 1, above=True)
    similarity: str = choice("product", "cosine")
    precision: str = choice("float32", "float16", "int8")

    def __post_init__(self) -> None:
        super().__post_init__()
        require_fits("width", self.width, lambda width: width % 8 == 0, "a multiple of 8")

    def embedder(self, part: Part, channels: int) -> "NetworkEmbedder":
        """From a map."""
        return NetworkEmbedder.of(self, part, channels)


@dataclass(frozen=True)
class TripletRecipe(Checked):
    """Parameters of the triplet network; defaults are the paper's, and ours where it has none.

    `width`: channels of its first stage, 64 in ResNet34; embeddings have 16 times as many numbers.
    `margin`: alpha of equation 2, squared distances (ours). `mining`: "hardest" or "semihard"
    negatives (ours). `apart`: distance of another place in tile widths (ours). The others are as in
    `AutoEncoderRecipe`, for Adam."""

    width: int = within(64, 1, 256)
    epochs: int = within(200, 1, 100_000)
    batch: int = within(512, 2, 65_536)
    learning_rate: float = within(1e-3, 0, 1, above=True)
    margin: float = within(1.0, 0, 1e6, above=True)
    mining: str = choice("hardest", "semihard")
    apart: float = within(0.25, 0, 100)
    similarity: str = choice("product", "cosine")
    precision: str = choice("float32", "float16", "int8")

    @property
    def dims(self) -> int:
        return 16 * self.width

    def embedder(self, part: Part, channels: int) -> "NetworkEmbedder":
        """From a map."""
        return NetworkEmbedder.of(self, part, channels)


@dataclass(frozen=True, eq=False)
class NetworkEmbedder:
    """A learnt encoder: `onnx` is its graph as bytes (n,) uint8.

    "maps" (N, C, S, S) to "embedding" (N, D), float32, N free. Raises `MapFileError` for other
    graphs, at first use at the latest, and `MissingExtraError` then."""

    recipe: AutoEncoderRecipe | TripletRecipe
    onnx: NDArray[np.uint8]
    threads: int = 1

    def __post_init__(self) -> None:
        if self.onnx.dtype != np.uint8 or self.onnx.ndim != 1:
            raise MapFileError(f"encoder must be bytes, got {self.onnx.dtype} {self.onnx.shape}")
        check_graph(self.onnx)

    @classmethod
    def of(
        cls, recipe: AutoEncoderRecipe | TripletRecipe, part: Part, channels: int
    ) -> "NetworkEmbedder":
        """Fails here, not at the first view, where onnxruntime is absent."""
        made = cls(recipe, part("onnx", np.uint8, 1))
        if made.shape[0] != channels:
            raise MapFileError(
                f"map's encoder takes {made.shape[0]} channels, its representation has {channels}"
            )
        return made

    def __getstate__(self) -> dict[str, Any]:
        """All but the running session."""
        return {"recipe": self.recipe, "onnx": self.onnx, "threads": self.threads}

    @property
    def dims(self) -> int:
        return self.recipe.dims

    @property
    def shape(self) -> tuple[int, int, int]:
        """(C, S, S) of what is embedded."""
        _, channels, height, width = self._session.get_inputs()[0].shape
        return int(channels), int(height), int(width)

    def view(self, maps: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Raises `ValueError` for shapes that the encoder was not learnt for."""
        if valid.shape != maps.shape[1:]:
            raise ValueError(f"valid must be {maps.shape[1:]}, got {valid.shape}")
        return np.asarray(self.views(np.where(valid, maps, np.float32(0))[None])[0])

    def views(self, maps: NDArray[np.float32]) -> NDArray[np.float32]:
        """(N, D) of (N, C, S, S); unit vectors for "cosine". Raises `ValueError`."""
        if maps.ndim != 4 or maps.shape[1:] != self.shape:
            raise ValueError(f"maps must be (N, {self.shape}), got {maps.shape}")
        out = np.empty((len(maps), self.dims), dtype=np.float32)
        # Enough to keep a core busy, few enough for a small machine's memory.
        for start in range(0, len(maps), 16):
            part = np.ascontiguousarray(maps[start : start + 16], dtype=np.float32)
            out[start : start + 16] = self._session.run(["embedding"], {"maps": part})[0]
        if not np.isfinite(out).all():
            raise MapFileError("map's encoder gives numbers that are not finite")
        if self.recipe.similarity == "cosine":
            out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), np.float32(1e-12))
        return out

    def parts(self) -> dict[str, NDArray[Any]]:
        return {"onnx": self.onnx}

    @cached_property
    def _session(self) -> Any:
        """Made at first use; threads may share it."""
        runtime = _onnxruntime()
        try:
            session = session_of(runtime, self.onnx.tobytes(), self.threads)
        except Exception as error:
            # Its errors have no common class below Exception.
            raise MapFileError(f"map's encoder cannot be loaded: {error}") from error
        self._check_interface(session)
        return session

    def _check_interface(self, session: Any) -> None:
        sides = [
            [(end.name, end.type, list(end.shape)) for end in ends]
            for ends in (session.get_inputs(), session.get_outputs())
        ]
        match sides:
            case [
                [("maps", "tensor(float)", [str() | None, int(), int() as rows, int() as cols])],
                [("embedding", "tensor(float)", [str() | None, int() as dims])],
            ] if rows == cols and dims == self.dims:
                return
        raise MapFileError(
            f"map's encoder must take maps (N, C, S, S) and give embedding (N, {self.dims}) "
            f"in float32, got {sides[0]} and {sides[1]}"
        )


def _onnxruntime() -> Any:
    return needed("onnxruntime", "neural", "running a neural encoder")


def session_of(runtime: Any, data: bytes, threads: int = 1) -> Any:
    """A session of onnxruntime for a graph; raises its own errors."""
    options = runtime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4  # errors are raised
    options.add_session_config_entry("session.load_model_format", "ONNX")
    # Threads that wait must not use time that the aircraft needs.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return runtime.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def check_graph(data: NDArray[np.uint8]) -> None:
    """Raise `MapFileError` unless bytes (n,) are one plain ONNX graph that holds all its weights.

    Only the layout is read (onnx.proto, IR version 8): operators of `OPERATORS` in the standard
    domain, no functions, no graphs inside the graph, no weights in other files."""
    whole = np.ascontiguousarray(data).data
    graphs = 0
    for number, value in _fields(whole):
        if number in (20, 25):  # training_info, functions
            raise MapFileError("map's encoder holds more than a graph")
        if number == 7:
            graphs += 1
            _check_layers(_bytes(value))
    if graphs != 1:
        raise MapFileError("map's encoder is not an ONNX graph")


def _check_layers(graph: memoryview) -> None:
    for number, value in _fields(graph):
        if number == 1:
            _check_layer(_bytes(value))
        elif number == 5:
            _check_tensor(_bytes(value))
        elif number == 15:  # sparse_initializer
            raise MapFileError("map's encoder holds sparse weights")


def _check_layer(node: memoryview) -> None:
    operator = ""
    for number, value in _fields(node):
        if number == 4:
            operator = bytes(_bytes(value)).decode("utf-8", "replace")
        elif number == 7 and bytes(_bytes(value)) not in (b"", b"ai.onnx"):
            raise MapFileError("map's encoder needs operators of another domain")
        elif number == 5:
            for inner, _ in _fields(_bytes(value)):
                if inner in (5, 6, 10, 11, 14, 15, 22, 23):  # tensors, graphs, types
                    raise MapFileError("map's encoder holds graphs or tensors inside its layers")
    if operator not in OPERATORS:
        raise MapFileError(f"map's encoder holds an operator that encoders do not: '{operator}'")


def _check_tensor(tensor: memoryview) -> None:
    for number, value in _fields(tensor):
        if number == 13 or (number == 14 and value != 0):  # external_data, data_location
            raise MapFileError("map's encoder keeps its weights in another file")


def _bytes(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise MapFileError("map's encoder is not an ONNX graph")
    return value


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Fields of a Protocol Buffers message: number, and integer or bytes (encoding guide)."""
    at, end = 0, len(message)
    while at < end:
        key, at = _varint(message, at)
        number, kind = key >> 3, key & 7
        if kind == 0:
            value, at = _varint(message, at)
            yield number, value
            continue
        size = {1: 8, 5: 4}.get(kind)
        if kind == 2:
            size, at = _varint(message, at)
        if size is None or number == 0 or at + size > end:
            raise MapFileError("map's encoder is not an ONNX graph, or is truncated")
        yield number, message[at : at + size]
        at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            break
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise MapFileError("map's encoder is not an ONNX graph, or is truncated")
