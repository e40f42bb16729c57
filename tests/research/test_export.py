"""An exported encoder equals PyTorch, in fewer bytes if that costs little accuracy."""

import numpy as np
import pytest
import torch
from torch import nn

from orthonav.core.tiles.network import AutoEncoderRecipe, TripletRecipe
from orthonav.research import export
from orthonav.research.autoencoder import AutoEncoder
from orthonav.research.export import ExportError, export_encoder, least_cosine_between
from orthonav.research.triplet import ResNet34


def maps(count, tile_px, seed=0, channels=1):
    """Tiles like edge maps, one of them blank."""
    rng = np.random.default_rng(seed)
    made = (rng.random((count, channels, tile_px, tile_px)) > 0.9).astype(np.float32)
    made[0] = 0
    return made


def encoder_and_recipe(kind, tile_px, channels=1, **fields):
    torch.manual_seed(0)
    if kind == "triplet":
        encoder = ResNet34(tile_px=tile_px, channels=channels, width=8)
        recipe = TripletRecipe(width=8, **fields)
    else:
        encoder = AutoEncoder(tile_px=tile_px, channels=channels, width=64, dims=24).encoder
        recipe = AutoEncoderRecipe(width=64, dims=24, **fields)
    for norm in encoder.modules():
        if isinstance(norm, nn.BatchNorm2d):
            norm.momentum = None  # the plain mean over all batches
    encoder.train()
    with torch.no_grad():
        for step in range(3):
            encoder(torch.from_numpy(maps(8, tile_px, step, channels)))
    return encoder, recipe


def embedded(encoder, tiles):
    encoder.eval()
    with torch.no_grad():
        return encoder(torch.from_numpy(tiles)).numpy()


@pytest.mark.parametrize("kind", ["autoencoder", "triplet"])
@pytest.mark.parametrize("tile_px, channels", [(32, 1), (64, 2), (96, 1)])
def test_the_export_equals_pytorch(kind, tile_px, channels):
    encoder, recipe = encoder_and_recipe(kind, tile_px, channels)
    tiles = maps(5, tile_px, 7, channels)
    made = export_encoder(encoder, recipe, tiles, tiles)
    expected = embedded(encoder, tiles)
    np.testing.assert_allclose(
        made.embedder.views(tiles), expected, atol=1e-4 * float(np.abs(expected).max())
    )
    assert made.precision == "float32"
    assert made.embedder.shape == (channels, tile_px, tile_px)


@pytest.mark.parametrize("kind", ["autoencoder", "triplet"])
@pytest.mark.parametrize("precision, most", [("float16", 0.56), ("int8", 0.45)])
def test_reduced_precisions_are_smaller_and_close_to_float32(kind, precision, most):
    encoder, recipe = encoder_and_recipe(kind, 64, precision=precision)
    tiles = maps(6, 64, 7)
    made = export_encoder(encoder, recipe, maps(16, 64, 5), tiles, least_cosine=0.9)
    assert (made.precision, made.least_cosine) == (precision, 0.9)
    assert made.embedder.recipe == recipe
    assert made.sizes_mb[precision] < most * made.sizes_mb["float32"]
    assert made.embedder.onnx.nbytes / 1e6 == pytest.approx(made.sizes_mb[precision])
    seen, expected = made.embedder.views(tiles), embedded(encoder, tiles)
    assert not np.array_equal(seen, expected)
    assert least_cosine_between(seen, expected) == pytest.approx(made.cosine[precision], abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float16", "int8"])  # those of float32: test_training.py
def test_the_same_weights_give_the_same_bytes(precision):
    encoder, recipe = encoder_and_recipe("triplet", 32, precision=precision)
    tiles = maps(8, 32)
    first, second = (export_encoder(encoder, recipe, tiles, tiles) for _ in range(2))
    np.testing.assert_array_equal(first.embedder.onnx, second.embedder.onnx)


def test_a_precision_that_is_too_inaccurate_is_not_used():
    encoder, recipe = encoder_and_recipe("autoencoder", 32, precision="int8")
    tiles = maps(8, 32)
    made = export_encoder(encoder, recipe, tiles, tiles, least_cosine=1.1)
    assert made.precision == made.embedder.recipe.precision == "float32"
    assert set(made.cosine) == {"float32", "int8"}
    assert made.embedder.onnx.nbytes / 1e6 == pytest.approx(made.sizes_mb["float32"])


def test_an_export_that_differs_from_pytorch_is_an_error(monkeypatch):
    """A batch norm that is left out must be detected."""
    encoder, recipe = encoder_and_recipe("autoencoder", 32)
    original = export._Graph.convolution
    monkeypatch.setattr(
        export._Graph,
        "convolution",
        lambda self, layer, norm, value: original(self, layer, None, value),
    )
    with pytest.raises(ExportError, match="disagree"):
        export_encoder(encoder, recipe, maps(4, 32), maps(4, 32))


@pytest.mark.parametrize("unknown", [nn.Sequential(nn.Tanh()), nn.Linear(2, 2)])
def test_unknown_layers_are_refused(unknown):
    with pytest.raises(TypeError, match="exported"):
        export.encoder_graph(unknown, (1, 32, 32))
