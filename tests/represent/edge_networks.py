"""Networks of one convolution, for tests of edges by a network."""

import numpy as np


def sharp(side=5, threshold=0.02):
    """Kernel of a pixel's difference to its neighbourhood."""
    kernel = np.full((1, 1, side, side), 1 / side**2, np.float32)
    kernel[0, 0, side // 2, side // 2] -= 1
    return kernel, np.array([-threshold], np.float32)


def write(
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
