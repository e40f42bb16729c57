"""A network in a map: embeds as it should, and nothing but plain layers gets in."""

import pickle
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import onnx
import pytest

from orthonav.core.errors import MapFileError, MissingExtraError
from orthonav.core.tiles.network import AutoEncoderRecipe, NetworkEmbedder

helper, FLOAT = onnx.helper, onnx.TensorProto.FLOAT

SIDE, DIMS = 8, 5
RECIPE = AutoEncoderRecipe(dims=DIMS, width=8)
WEIGHTS = np.random.default_rng(0).normal(size=(DIMS, 2 * SIDE * SIDE)).astype(np.float32)


def graph(*, nodes=None, weights=WEIGHTS, inputs=None, outputs=None, functions=(), name="maps"):
    """An encoder of one dense layer, or a changed one."""
    nodes = nodes or [helper.make_node("Flatten", [name], ["flat"], axis=1), dense("flat")]
    inputs = inputs or [info(name, ["N", 2, SIDE, SIDE])]
    outputs = outputs or [info("embedding", ["N", DIMS])]
    tensors = [onnx.numpy_helper.from_array(weights, "w")]
    made = helper.make_model(
        helper.make_graph(nodes, "encoder", inputs, outputs, tensors),
        opset_imports=[helper.make_opsetid("", 17)],
        functions=functions,
    )
    made.ir_version = 8
    return made


def dense(source):
    return helper.make_node("Gemm", [source, "w"], ["embedding"], transB=1)


def info(name, shape):
    return helper.make_tensor_value_info(name, FLOAT, shape)


def embedder(model=None, recipe=RECIPE):
    data = (model or graph()).SerializeToString()
    return NetworkEmbedder(recipe, np.frombuffer(data, np.uint8))


def maps(count, seed=1):
    return np.random.default_rng(seed).random((count, 2, SIDE, SIDE), dtype=np.float32)


def test_it_gives_what_the_graph_computes():
    seen = maps(40)
    wanted = seen.reshape(40, -1) @ WEIGHTS.T
    made = embedder().views(seen)
    assert made.dtype == np.float32
    np.testing.assert_allclose(made, wanted, rtol=1e-4, atol=1e-5)
    everywhere = np.ones((SIDE, SIDE), bool)
    np.testing.assert_allclose(embedder().view(seen[3], everywhere), wanted[3], rtol=1e-4)
    assert embedder().views(seen[:0]).shape == (0, DIMS)
    assert embedder().dims == DIMS
    assert embedder().shape == (2, SIDE, SIDE)


def test_what_is_not_valid_counts_as_zero():
    seen, valid = maps(1)[0], np.random.default_rng(2).random((SIDE, SIDE)) > 0.5
    kept = seen.copy()
    made = embedder().view(seen, valid)
    np.testing.assert_allclose(made, embedder().views((seen * valid)[None])[0], rtol=1e-5)
    np.testing.assert_array_equal(seen, kept)
    spoilt = np.where(valid, seen, np.float32(np.nan))
    np.testing.assert_array_equal(embedder().view(spoilt, valid), made)


def test_cosine_gives_unit_vectors_and_zero_for_nothing():
    cosine = embedder(recipe=AutoEncoderRecipe(dims=DIMS, similarity="cosine"))
    made = cosine.views(maps(4))
    np.testing.assert_allclose(np.linalg.norm(made, axis=1), 1, rtol=1e-5)
    plain = embedder().views(maps(4))
    np.testing.assert_allclose(
        made, plain / np.linalg.norm(plain, axis=1, keepdims=True), rtol=1e-4
    )
    np.testing.assert_array_equal(cosine.views(np.zeros((1, 2, SIDE, SIDE), np.float32)), 0)


def test_it_travels_and_is_the_same_in_many_threads():
    one = embedder()
    wanted = one.views(maps(6))
    again = pickle.loads(pickle.dumps(one))
    np.testing.assert_array_equal(again.views(maps(6)), wanted)
    np.testing.assert_array_equal(again.parts()["onnx"], one.onnx)
    fresh = embedder()
    with ThreadPoolExecutor(8) as pool:
        for made in pool.map(lambda _: fresh.views(maps(6)), range(40)):
            np.testing.assert_array_equal(made, wanted)


@pytest.mark.parametrize("shape", [(1, 2, SIDE, SIDE + 1), (1, 1, SIDE, SIDE), (2, SIDE, SIDE)])
def test_views_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match="maps must be"):
        embedder().views(np.zeros(shape, np.float32))


def test_without_onnxruntime_the_error_says_what_to_install(monkeypatch):
    made = embedder()
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'orthonav\[neural\]'"):
        made.views(maps(1))


WHOLE = graph().SerializeToString()


@pytest.mark.parametrize(
    "data",
    [b"", b"garbage", b"\x00" * 64, b"\xff" * 64, WHOLE[:-1], WHOLE[: len(WHOLE) // 2], WHOLE * 2],
    ids=["empty", "garbage", "zeros", "ones", "cut", "half", "twice"],
)
def test_bytes_that_are_no_graph_are_refused(data):
    with pytest.raises(MapFileError):
        NetworkEmbedder(RECIPE, np.frombuffer(data, np.uint8))


def test_altered_bytes_are_refused_or_give_numbers():
    """Whatever a flipped byte means, it is no crash and no surprise of another kind."""
    rng = np.random.default_rng(0)
    refused = 0
    for at in rng.integers(0, len(WHOLE), 60):
        data = np.frombuffer(WHOLE, np.uint8).copy()
        data[at] ^= rng.integers(1, 256, dtype=np.uint8)
        try:
            assert np.isfinite(NetworkEmbedder(RECIPE, data).views(maps(2))).all()
        except MapFileError:
            refused += 1
        except ValueError as error:
            assert "maps must be" in str(error)
    assert 0 < refused < 60


def external(model):
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="/etc/passwd")
    return model


def test_weights_in_other_files_are_refused():
    with pytest.raises(MapFileError, match="another file"):
        embedder(external(graph()))
    pointed = external(graph())
    pointed.graph.initializer[0].ClearField("data_location")
    with pytest.raises(MapFileError, match="another file"):
        embedder(pointed)


def strange_graphs():
    flat = helper.make_node("Flatten", ["maps"], ["flat"], axis=1)
    inner = helper.make_graph([], "inner", [], [])
    tensor = onnx.numpy_helper.from_array(np.zeros(2, np.float32), "t")
    for name, operator, source, more in (
        ("tensor", "Identity", "flat", {"value": tensor}),
        ("graph", "Identity", "flat", {"body": inner}),
        ("domain", "Identity", "flat", {"domain": "com.microsoft"}),
        ("loop", "Loop", "flat", {"body": inner}),
        ("huge", "ConstantOfShape", "w", {}),
    ):
        node = helper.make_node(operator, [source], ["same"], **more)
        yield pytest.param(graph(nodes=[flat, node, dense("same")]), id=name)
    opset = helper.make_opsetid("", 17)
    function = helper.make_function("x", "F", ["a"], ["a"], [], [opset])
    yield pytest.param(graph(functions=[function]), id="function")


@pytest.mark.parametrize("model", list(strange_graphs()))
def test_anything_but_plain_layers_is_refused_before_it_is_loaded(model, monkeypatch):
    monkeypatch.setattr(
        "orthonav.core.tiles.network._onnxruntime", lambda: pytest.fail("was loaded")
    )
    with pytest.raises(MapFileError, match=r"encoder (holds|needs)"):
        embedder(model)


@pytest.mark.parametrize(
    "model, recipe",
    [
        (graph(name="picture"), RECIPE),
        (graph(inputs=[info("maps", [1, 2, SIDE, SIDE])]), RECIPE),
        (graph(inputs=[info("maps", ["N", 2, 4, 16])]), RECIPE),
        (graph(inputs=[info("maps", ["N", 2, "S", "S"])]), RECIPE),
        (graph(inputs=[info("maps", ["N", 2, SIDE, SIDE]), info("more", ["N"])]), RECIPE),
        (graph(), AutoEncoderRecipe(dims=DIMS + 1)),
        (graph(outputs=[info("embedding", ["N", DIMS]), info("flat", ["N", 128])]), RECIPE),
    ],
    ids=["name", "one", "oblong", "free", "two", "dims", "outputs"],
)
def test_graphs_that_take_or_give_something_else_are_refused(model, recipe):
    with pytest.raises(MapFileError, match="must take maps"):
        embedder(model, recipe).views(maps(1))


def test_embeddings_that_are_not_finite_are_refused():
    endless = graph(weights=np.full_like(WEIGHTS, np.inf))
    with pytest.raises(MapFileError, match="not finite"):
        embedder(endless).views(maps(1))
