"""The auto-encoder reconstructs tiles of any size; pictures show what it does."""

import numpy as np
import pytest
import torch

from orthonav.research.autoencoder import AutoEncoder, reconstructions
from orthonav.research.tiles import SheetTiles


@pytest.mark.long
def test_only_binary_inputs_end_in_a_sigmoid():
    pictures = []
    for binary in (True, False):
        torch.manual_seed(0)
        model = AutoEncoder(tile_px=32, width=8, dims=8, binary=binary)
        pictures.append(model(torch.rand(2, 1, 32, 32, generator=torch.Generator().manual_seed(1))))
    torch.testing.assert_close(pictures[0], torch.sigmoid(pictures[1]))


def test_the_picture_shows_tiles_above_their_reconstructions():
    pixels = np.random.default_rng(0).integers(0, 256, (1, 64, 64), dtype=np.uint8)
    tiles = SheetTiles(pixels, np.ones((64, 64), bool), np.array([[0, 0], [32, 32]]), 32)
    model = AutoEncoder(tile_px=32, width=8, dims=8).train()
    picture = reconstructions(model, tiles)
    assert picture.shape == (64, 64)
    np.testing.assert_allclose(picture[:32, :32], pixels[0, :32, :32], atol=1)
    assert model.training, "must be left as it was"
