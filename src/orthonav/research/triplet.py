"""The triplet model of Di Piazza et al. 2024: tiles (N, C, 256, 256) to embeddings (N, 1024).

"The Encoder architecture corresponds to the ResNet34 implementation. The latent space dimension is
1024. The neural network has 21 278 400 parameters. We add a hard negative mining step" (section
Methodology, Considered methods). That count is ResNet34 (He et al., CVPR 2016, table 1) with one
input channel and without its last dense layer; its 512 channels averaged over the left and the
right half of the tile are the 1024 numbers. The loss is equation 2 (section Related work, Triplet
Model), which is FaceNet's (Schroff et al., CVPR 2015).

The paper leaves open the margin alpha, how negatives are mined and where a training set of one year
gets its positives. Here the margin is 1 by default, negatives are other places in the batch, and
positives are the same tiles of further dates or simulated ageing.

Its parameters are those of `core.tiles.network.TripletRecipe`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from orthonav.core.tiles.network import TripletRecipe
from orthonav.research.tiles import SheetTiles

BLOCKS = (3, 4, 6, 3)
"""Blocks of two convolutions in each of the four stages: ResNet34."""

Positive = Callable[[np.random.Generator, NDArray[np.uint8]], NDArray[Any]]
"""Function from grey levels (S, S) uint8 to a tile of another date, (S, S) or (C, S, S): uint8 in
units of the sheet's pixels, or float32 in units of 1.0."""


class BasicBlock(nn.Module):
    """Residual block: two 3 x 3 convolutions and a shortcut, projected if the sizes differ."""

    def __init__(self, before: int, after: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(before, after, 3, stride, 1, bias=False)
        self.first_norm = nn.BatchNorm2d(after)
        self.second = nn.Conv2d(after, after, 3, 1, 1, bias=False)
        self.second_norm = nn.BatchNorm2d(after)
        # The name is part of stored checkpoints.
        self.short_cut: nn.Sequential | None = None
        if stride != 1 or before != after:
            self.short_cut = nn.Sequential(
                nn.Conv2d(before, after, 1, stride, bias=False), nn.BatchNorm2d(after)
            )

    def forward(self, values: Tensor) -> Tensor:
        """Features (N, after, h, w) of features (N, before, H, W)."""
        shortcut = values if self.short_cut is None else self.short_cut(values)
        residual = functional.relu(self.first_norm(self.first(values)), inplace=True)
        residual = self.second_norm(self.second(residual))
        return functional.relu(residual + shortcut, inplace=True)


class ResNet34(nn.Module):
    """Encoder of tiles (N, C, S, S) into vectors (N, 16 * width).

    `width` is the number of channels of the first stage, 64 in ResNet34; it doubles three times.
    """

    def __init__(self, *, tile_px: int = 256, channels: int = 1, width: int = 64) -> None:
        super().__init__()
        self.tile_px, self.channels, self.dims = tile_px, channels, 16 * width
        self.stem = nn.Sequential(
            nn.Conv2d(channels, width, 7, 2, 3, bias=False),
            nn.BatchNorm2d(width),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(3, 2, 1),
        )
        blocks, before = [], width
        for stage, count in enumerate(BLOCKS):
            after = width * 2**stage
            for number in range(count):
                stride = 2 if stage and number == 0 else 1
                blocks.append(BasicBlock(before, after, stride))
                before = after
        self.blocks = nn.Sequential(*blocks)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, tiles: Tensor) -> Tensor:
        """Embeddings (N, D) float32: channels averaged over the left and the right half."""
        features = self.blocks(self.stem(tiles))
        return functional.adaptive_avg_pool2d(features, (1, 2)).flatten(1).float()


def squared_distances(first: Tensor, second: Tensor) -> Tensor:
    """Squared distances (A, B) of vectors (A, D) and (B, D), in float32."""
    products = first.float() @ second.float().T
    lengths = first.float().square().sum(1)[:, None] + second.float().square().sum(1)
    return (lengths - 2 * products).clamp_min(0)


def hard_negatives(
    anchors: Tensor, positive_distances: Tensor, apart: Tensor, *, semi_hard: bool
) -> Tensor:
    """Row (B,) of the negative for each anchor (B, D) among the other anchors; -1 if there is none.

    Negatives show another place on the same date; `apart` (B, B) bool marks pairs of different
    places. The hardest negative is the nearest one. The semi-hard negative is the nearest one that
    is farther than the positive, whose squared distances are given (B,); if there is none, the
    hardest negative is taken.
    """
    distances = squared_distances(anchors, anchors).masked_fill(~apart, torch.inf)
    nearest, rows = distances.min(dim=1)
    if semi_hard:
        beyond = distances.masked_fill(distances <= positive_distances[:, None], torch.inf)
        nearest_beyond, rows_beyond = beyond.min(dim=1)
        rows = torch.where(torch.isfinite(nearest_beyond), rows_beyond, rows)
    return torch.where(torch.isfinite(nearest), rows, -1)


def triplet_loss(
    anchors: Tensor, positives: Tensor, apart: Tensor, *, margin: float, semi_hard: bool
) -> Tensor:
    """Equation 2, mean over anchors: max(0, ||xa - xp||^2 - ||xa - xn||^2 + margin), xn mined.

    `anchors` and `positives` (B, D); `apart` (B, B) as in `hard_negatives`. Anchors without a
    negative are left out; if no anchor has one, loss and gradient are zero.
    """
    near = (anchors.float() - positives.float()).square().sum(1)
    with torch.no_grad():
        rows = hard_negatives(anchors, near, apart, semi_hard=semi_hard)
    known = (rows >= 0).float()
    far = (anchors.float() - anchors.float()[rows.clamp_min(0)]).square().sum(1)
    losses = functional.relu(near - far + margin) * known
    return losses.sum() / known.sum().clamp_min(1)


class Triplets:
    """The triplet task: each tile with another date of it, negatives mined in the batch."""

    def __init__(
        self,
        recipe: TripletRecipe,
        tiles: SheetTiles,
        positive: Positive | Sequence[SheetTiles],
        *,
        seed: int,
        chunk: int,
    ) -> None:
        self.recipe, self.tiles, self.positive = recipe, tiles, positive
        self.seed, self.chunk = seed, max(2, chunk // 2 * 2)
        self.encoder = self.model = ResNet34(
            tile_px=tiles.tile_px, channels=tiles.channels, width=recipe.width
        )

    def arrays(self, epoch: int, indices: NDArray[np.intp]) -> tuple[NDArray[Any], ...]:
        """Tiles and positives in alternation (2B, C, S, S), and the mask (B, B) of pairs apart."""
        anchors = self.tiles.batch(indices)
        both = np.empty((2 * len(indices), *anchors.shape[1:]), np.float32)
        both[0::2] = anchors
        for row, index in enumerate(indices):
            self._write_positive(epoch, int(index), both[2 * row + 1])
        place = np.asarray(self.tiles.tiles_px)[indices].astype(np.int64)
        steps = np.abs(place[:, None] - place).max(axis=2)
        return both, (steps > 0) & (steps >= self.recipe.apart * self.tiles.tile_px)

    def _write_positive(self, epoch: int, index: int, out: NDArray[np.float32]) -> None:
        rng = np.random.default_rng([self.seed, epoch, index])
        if not callable(self.positive):
            date = self.positive[int(rng.integers(len(self.positive)))]
            out[:] = date.batch(np.array([index]))[0]
            return
        made = self.positive(rng, self.tiles.grey_tile(index))
        made = made[None] if made.ndim == 2 else made
        if made.shape != out.shape or made.dtype not in (np.uint8, np.float32):
            raise ValueError(
                f"positive must be uint8 or float32 {out.shape}, got {made.dtype} {made.shape}"
            )
        valid = self.tiles.valid_tile(index)
        if made.dtype == np.uint8:
            self.tiles.scaled(made, valid, out)
        else:
            np.multiply(made, valid, out=out)

    def backward(self, *tensors: Tensor, scale: Tensor) -> Tensor:
        """The triplet loss, after adding its gradients times `scale`.

        A batch larger than `chunk` is embedded twice (Gao et al. 2021, arXiv 2101.06983): first
        without gradients, for the gradient of the loss with respect to the embeddings, then chunk
        by chunk with gradients. Memory therefore does not grow with the batch.
        """
        both, apart = tensors
        if len(both) <= self.chunk:
            loss = self._loss(self.model(both), apart)
            torch.autograd.backward(loss * scale)
            return loss.detach()
        parts = torch.split(both, self.chunk)
        with torch.no_grad():
            embedded = torch.cat([self.model(part) for part in parts])
        loss = self._loss(embedded.requires_grad_(), apart)
        (wanted,) = torch.autograd.grad(loss * scale, embedded)
        for part, gradient in zip(parts, torch.split(wanted, self.chunk), strict=True):
            torch.autograd.backward(self.model(part), gradient)
        return loss.detach()

    def _loss(self, embedded: Tensor, apart: Tensor) -> Tensor:
        if self.recipe.similarity == "cosine":
            embedded = functional.normalize(embedded, dim=1)
        return triplet_loss(
            embedded[0::2],
            embedded[1::2],
            apart,
            margin=self.recipe.margin,
            semi_hard=self.recipe.mining == "semihard",
        )
