"""The auto-encoder of Di Piazza et al. 2024: tiles (N, C, 256, 256) to vectors (N, 1024) and back.

"The Encoder consists of 4 strided convolutional layers, followed by batch normalization and a
LeakyReLU activation function. The latent space dimension is 1024. The Decoder consists of 4
deconvolution layers, followed by batch normalization and a LeakyReLU activation function. If the
inputs are binary maps, a sigmoid is added to the last layer of the Decoder. The neural network has
172 506 561 parameters." (section Methodology, Considered methods). The loss is equation 1 (section
Related work, Auto-Encoder, after Bianchi and Barfoot 2021).

The text leaves kernels and widths open. The count comes out exactly with strided convolutions of
3 x 3 and widths 64, 128, 256, 512, 512: five, as in the authors' released code, not four; a dense
layer from 8 x 8 x 512 to 1024 numbers and one back to 16 x 16 x 512; and transposed convolutions of
2 x 2 to 256, 128, 64 and 1 channels, each but the last normalized and rectified.

Its parameters are those of `core.tiles.network.AutoEncoderRecipe`.
"""

from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from orthonav.core.tiles.network import AutoEncoderRecipe
from orthonav.research.tiles import SheetTiles

STRIDE_PX = 2
DOWN, UP = 5, 4
"""Strided convolutions of the encoder and of the decoder."""
SHOWN_TILES = 6
SLOPE = 0.2
"""Slope of LeakyReLU below zero: usual with strided convolutions; the paper gives none."""


class AutoEncoder(nn.Module):
    """Auto-encoder for tiles (N, C, S, S) of `tile_px` S; only `encoder` flies.

    `width` is the number of channels before the dense layer, a multiple of 8. `binary` adds the
    sigmoid.
    """

    def __init__(
        self,
        *,
        tile_px: int = 256,
        channels: int = 1,
        width: int = 512,
        dims: int = 1024,
        binary: bool = True,
    ) -> None:
        super().__init__()
        self.tile_px, self.channels, self.dims, self.binary = tile_px, channels, dims, binary
        widths = [channels, width // 8, width // 4, width // 2, width, width]
        side = -(-tile_px // STRIDE_PX**DOWN)
        self.encoder = nn.Sequential(
            *(layer for pair in pairwise(widths) for layer in _down(*pair)),
            nn.Flatten(),
            nn.Linear(width * side**2, dims),
        )
        back = [width, width // 2, width // 4, width // 8]
        side = tile_px // STRIDE_PX**UP
        self.decoder = nn.Sequential(
            nn.Linear(dims, width * side**2),
            nn.Unflatten(1, (width, side, side)),
            *(layer for pair in pairwise(back) for layer in _up(*pair)),
            # No norm and no rectifier at the output: it must reach all pixel values.
            nn.ConvTranspose2d(back[-1], channels, STRIDE_PX, STRIDE_PX),
        )

    def forward(self, tiles: Tensor) -> Tensor:
        """Reconstructions (N, C, S, S) float32 of tiles (N, C, S, S)."""
        picture: Tensor = self.decoder(self.encoder(tiles)).float()
        return torch.sigmoid(picture) if self.binary else picture


def reconstruction_loss(tiles: Tensor, reconstructed: Tensor) -> Tensor:
    """Equation 1, ||I - D(E(I))||^2, of (N, C, S, S); here the mean over pixels and tiles."""
    return torch.mean((tiles - reconstructed) ** 2)


class Reconstruction:
    """The auto-encoder: tiles are their own targets."""

    def __init__(self, recipe: AutoEncoderRecipe, tiles: SheetTiles, *, binary: bool) -> None:
        self.tiles = tiles
        self.model = AutoEncoder(
            tile_px=tiles.tile_px,
            channels=tiles.channels,
            width=recipe.width,
            dims=recipe.dims,
            binary=binary,
        )
        self.encoder: nn.Module = self.model.encoder

    def arrays(self, epoch: int, indices: NDArray[np.intp]) -> tuple[NDArray[Any], ...]:
        """Tiles (B, C, S, S)."""
        return (self.tiles.batch(indices),)

    def backward(self, *tensors: Tensor, scale: Tensor) -> Tensor:
        (maps,) = tensors
        loss = reconstruction_loss(maps, self.model(maps))
        torch.autograd.backward(loss * scale)
        return loss.detach()


def reconstructions(model: AutoEncoder, tiles: SheetTiles) -> NDArray[np.uint8]:
    """Some tiles above their reconstructions, (2S, K * S), first channel."""
    indices = np.unique(np.linspace(0, len(tiles) - 1, SHOWN_TILES).astype(np.intp))
    maps = torch.from_numpy(tiles.batch(indices))
    was_training = model.training
    model.eval()
    with torch.no_grad():
        made = model(maps.to(next(model.parameters()).device)).cpu()
    model.train(was_training)
    rows = [np.concatenate(list(part[:, 0].numpy()), axis=1) for part in (maps, made)]
    return np.asarray(np.clip(np.concatenate(rows) * 255, 0, 255), dtype=np.uint8)


def _down(before: int, after: int) -> list[nn.Module]:
    return [
        nn.Conv2d(before, after, 3, STRIDE_PX, 1),
        nn.BatchNorm2d(after),
        nn.LeakyReLU(SLOPE, inplace=True),
    ]


def _up(before: int, after: int) -> list[nn.Module]:
    return [
        nn.ConvTranspose2d(before, after, STRIDE_PX, STRIDE_PX),
        nn.BatchNorm2d(after),
        nn.LeakyReLU(SLOPE, inplace=True),
    ]
