"""Pictures, and networks of one convolution for edges by a network."""

import cv2
import numpy as np


def picture(shape=(96, 96), seed=0, blur=1.5):
    """Blurred noise over the whole range of grey levels, read-only."""
    noise = np.random.default_rng(seed).normal(size=shape).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), blur).reshape(shape)
    grey = cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8).reshape(shape)
    return frozen(grey)


def frozen(array):
    array.flags.writeable = False
    return array


def everywhere(grey):
    return frozen(np.ones(grey.shape, dtype=bool))


def sharp(side=5, threshold=0.02):
    """Kernel of a pixel's difference to its neighbourhood."""
    kernel = np.full((1, 1, side, side), 1 / side**2, np.float32)
    kernel[0, 0, side // 2, side // 2] -= 1
    return kernel, np.array([-threshold], np.float32)


def edge_network(
    path, *, kernel=None, pads=(0, 0, 0, 0), names=("grey", "edges"), kind=None, strides=(1, 1)
):
    """A network of one convolution."""
    import onnx

    weights, bias = sharp() if kernel is None else kernel
    helper, arrays = onnx.helper, onnx.numpy_helper
    kind = kind or onnx.TensorProto.FLOAT
    numbers = np.float32 if kind == onnx.TensorProto.FLOAT else np.float64
    node = helper.make_node(
        "Conv", [names[0], "w", "b"], [names[1]], pads=list(pads), strides=list(strides)
    )
    graph = helper.make_graph(
        [node],
        "edges",
        [helper.make_tensor_value_info(names[0], kind, [1, 1, None, None])],
        [helper.make_tensor_value_info(names[1], kind, [1, None, None, None])],
        [
            arrays.from_array(weights.astype(numbers), "w"),
            arrays.from_array(bias.astype(numbers), "b"),
        ],
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    made.ir_version = 8
    path.write_bytes(made.SerializeToString())
    return path
