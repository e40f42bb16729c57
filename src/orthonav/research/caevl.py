"""Learns CAEVL: the auto-encoder of the paper, then its encoder fine-tuned on augmented tiles.

Amadei et al., WACV 2026 (arXiv 2512.02737): "An autoencoder is trained using a pixel-wise L2 loss
and a perceptual loss. The decoder is then discarded and the encoder is fine-tuned using a
non-contrastive approach": VICReg on the embeddings of a tile and of the same tile augmented, and on
their feature maps before the dense layer, through projection heads that are discarded. The encoder
has the five strided convolutions of `orthonav.research.autoencoder`. Differences: there is no
perceptual loss, which needs DINOv2; LeakyReLU has the slope of our auto-encoder; and there is no
validation set that would stop a training early.

Augmentations: geometry (one of rotation, displacement and magnification), then blur, contrast and
brightness, in the ranges of the authors' released configuration. Their vignetting and the mask of
their camera are left out: they are of one camera.

VICReg: Bardes, Ponce and LeCun, ICLR 2022 (arXiv 2105.04906), algorithm 1; its local form: Bardes,
Ponce and LeCun, "VICRegL", NeurIPS 2022 (arXiv 2210.01571), section 3.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from orthonav.core.files import Progress
from orthonav.research.caevl_recipe import CaevlRecipe
from orthonav.research.tiles import SheetTiles
from orthonav.research.training import Means, TrainedNetwork, Training, finished, learn_network

GEOMETRY, LIGHT = 0.8, 0.5
"""Probability of a change of geometry, and of each of blur, contrast and brightness."""
TURN_DEG, SHIFT_PX, SHIFTED, LEAST_AREA = 30.0, 10.0, 0.75, 0.7
"""Largest rotation; largest displacement along an axis, at 256 px, and its probability; smallest
fraction of a tile that is magnified."""
SIDE_PX = 256.0
BLUR_PX, BLUR_KERNEL = (0.1, 2.0), 5
CONTRAST, BRIGHTNESS = (0.1, 2.0), (1.0, 2.0)
INVARIANCE, VARIANCE, COVARIANCE = 25.0, 25.0, 1.0
"""Weights of the three terms, of VICReg and of CAEVL."""
LEAST_SPREAD, TINY = 1.0, 1e-4
"""Standard deviation that every number of an embedding is held at, and what keeps its root off
zero."""
BEST_MATCHES = (20, 4)
"""Pairs by place that are compared, from the tile to the view and back, as in VICRegL."""
LOCAL_NUMBERS = 512
"""Numbers of the local projection head, over all of a feature map, as in the released code."""
FIRST = "autoencoder"
"""Folder of the auto-encoder's checkpoint, within that of the training."""

Represent = Callable[[NDArray[np.uint8], NDArray[np.bool_]], NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class Augmented:
    """`grey` (S, S) uint8, and where it shows the tile: `tile_from_view` (2, 3) maps x and y of a
    pixel coordinate in it to those in the tile (outer corner of the first pixel: 0, 0)."""

    grey: NDArray[np.uint8]
    tile_from_view: NDArray[np.float32]


def augmented(rng: np.random.Generator, grey: NDArray[np.uint8]) -> Augmented:
    """A tile (S, S) seen anew; every part of it lies within the tile."""
    size = grey.shape[0]
    matrix = _geometry(rng, size)
    half = np.full(2, 0.5)
    of_centres = matrix.copy()  # OpenCV counts from the centre of the first pixel
    of_centres[:, 2] += matrix[:, :2] @ half - half
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = cv2.warpAffine(
        grey, of_centres, (size, size), flags=flags, borderMode=cv2.BORDER_REPLICATE
    ).astype(np.float32)
    if rng.random() < LIGHT:
        blur = rng.uniform(*BLUR_PX)
        seen = cv2.GaussianBlur(seen, (BLUR_KERNEL, BLUR_KERNEL), blur).astype(np.float32)
    if rng.random() < LIGHT:
        mean = float(seen.mean())
        seen = np.clip(mean + (seen - mean) * np.float32(rng.uniform(*CONTRAST)), 0, 255)
    if rng.random() < LIGHT:
        seen = np.clip(seen * np.float32(rng.uniform(*BRIGHTNESS)), 0, 255)
    return Augmented(np.rint(seen).astype(np.uint8), matrix.astype(np.float32))


def _geometry(rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Tile from view (2, 3): rotation, displacement, magnification or nothing."""
    scale, turn, middle = np.ones(2), 0.0, np.full(2, size / 2)
    kind = rng.integers(3) if rng.random() < GEOMETRY else -1
    if kind == 0:
        turn = np.radians(rng.uniform(-TURN_DEG, TURN_DEG))
        scale /= abs(np.cos(turn)) + abs(np.sin(turn))  # the largest square within the tile
    elif kind == 1:
        shift = rng.uniform(-SHIFT_PX, SHIFT_PX, 2) * (rng.random(2) < SHIFTED) * size / SIDE_PX
        scale -= np.abs(shift) / size
        middle = middle - shift / 2
    elif kind == 2:
        scale *= np.sqrt(rng.uniform(LEAST_AREA, 1))
        middle = middle + rng.uniform(-1, 1, 2) * (1 - scale) * size / 2
    cos, sin = np.cos(turn), np.sin(turn)
    linear = np.array([[cos, -sin], [sin, cos]]) * scale
    return np.column_stack([linear, middle - linear @ np.full(2, size / 2)])


def vicreg(first: Tensor, second: Tensor) -> Tensor:
    """Loss of embeddings (..., B, D) of the same B things seen twice, the mean over `...`.

    Invariance: both are the same. Variance: every number differs between things. Covariance: no
    two numbers say the same. B at least 2.
    """
    first, second = first.float(), second.float()
    invariance = functional.mse_loss(first, second)
    spreads = [torch.sqrt(each.var(dim=-2) + TINY) for each in (first, second)]
    variance = sum(functional.relu(LEAST_SPREAD - each).mean() for each in spreads) / 2
    covariance = _covariance(first) + _covariance(second)
    return INVARIANCE * invariance + VARIANCE * variance + COVARIANCE * covariance


def _covariance(values: Tensor) -> Tensor:
    """Squared covariances of different numbers, summed, per number."""
    count, dims = values.shape[-2:]
    away = values - values.mean(dim=-2, keepdim=True)
    squared = (away.transpose(-2, -1) @ away / (count - 1)).square()
    diagonal = torch.diagonal(squared, dim1=-2, dim2=-1).sum(-1)
    return ((squared.sum((-2, -1)) - diagonal) / dims).mean()


def local_vicreg(
    first: Tensor, second: Tensor, first_places: Tensor, second_places: Tensor
) -> Tensor:
    """Loss of feature maps (B, C, h, w) of the same B things seen twice.

    `first_places`, `second_places` (B, h * w, 2): what part of the thing each feature shows. Each
    feature is compared with the most similar one of the other map, and those that lie nearest to
    one of the other map with that one.
    """
    one, other = (each.flatten(2).transpose(1, 2).float() for each in (first, second))
    alike = torch.cdist(one, other)
    near = torch.cdist(first_places, second_places)
    by_content = _matched(one, other, alike, None) + _matched(other, one, alike.mT, None)
    by_place = _matched(one, other, near, BEST_MATCHES[0])
    by_place = by_place + _matched(other, one, near.mT, BEST_MATCHES[1])
    return (by_content + by_place) / 2


def _matched(one: Tensor, other: Tensor, distances: Tensor, best: int | None) -> Tensor:
    """VICReg of features (B, P, C) and the nearest of the other ones by distances (B, P, P)."""
    least, nearest = distances.min(dim=2)
    rows = least.argsort(dim=1)[:, : best or least.shape[1]]
    columns = torch.gather(nearest, 1, rows)
    pairs = [
        torch.gather(each, 1, at[..., None].expand(-1, -1, each.shape[2])).transpose(0, 1)
        for each, at in ((one, rows), (other, columns))
    ]
    return vicreg(*pairs)


class Heads(nn.Module):
    """The encoder with its projection heads: global (N, D) and local (N, C, h, w) projections.

    `encoder`: the convolutions, a flattening and the dense layer of an auto-encoder.
    """

    def __init__(self, encoder: nn.Sequential, tile_px: int, channels: int, wide: int) -> None:
        super().__init__()
        self.encoder = encoder
        with torch.no_grad():
            maps = encoder[:-2].eval()(torch.zeros(1, channels, tile_px, tile_px))
        self.side = int(maps.shape[-1])
        local = max(1, LOCAL_NUMBERS // self.side**2) * self.side**2
        dense = encoder[-1]
        assert isinstance(dense, nn.Linear)
        self.global_head = _head(dense.out_features, wide)
        self.local_head = _head(maps.numel(), local)

    def forward(self, tiles: Tensor) -> tuple[Tensor, Tensor]:
        """Projections of tiles (N, C, S, S)."""
        features = self.encoder[:-2](tiles).flatten(1)
        if len(tiles) == 1:  # a batch norm needs two
            features = features.expand(2, -1)
        local = self.local_head(features).view(len(features), -1, self.side, self.side)
        return self.global_head(self.encoder[-1](features))[: len(tiles)], local[: len(tiles)]


def _head(before: int, wide: int) -> nn.Sequential:
    """Three dense layers of a width, as in the released code."""
    layers: list[nn.Module] = []
    for size in (before, wide):
        layers += [nn.Linear(size, wide), nn.BatchNorm1d(wide), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers, nn.Linear(wide, wide))


class Tuning:
    """The fine-tuning task: each tile with the same tile augmented."""

    def __init__(
        self,
        recipe: CaevlRecipe,
        tiles: SheetTiles,
        encoder: nn.Sequential,
        represent: Represent,
        seed: int,
    ) -> None:
        self.tiles, self.encoder, self.represent = tiles, encoder, represent
        self.alpha, self.seed = recipe.alpha, seed
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed + 1)
            self.model = Heads(encoder, tiles.tile_px, tiles.channels, recipe.projector)

    def arrays(self, epoch: int, indices: NDArray[np.intp]) -> tuple[NDArray[Any], ...]:
        """Tiles and augmented tiles (B, C, S, S), and where these show the tile (B, 2, 3)."""
        plain = self.tiles.batch(indices)
        seen = np.empty_like(plain)
        places = np.empty((len(indices), 2, 3), np.float32)
        for row, index in enumerate(indices):
            rng = np.random.default_rng([self.seed, epoch, int(index)])
            made = augmented(rng, self.tiles.grey_tile(int(index)))
            seen[row] = self.represent(made.grey, np.ones(made.grey.shape, np.bool_))
            places[row] = made.tile_from_view
        return plain, seen, places

    def backward(self, *tensors: Tensor, scale: Tensor) -> Tensor:
        plain, seen, tile_from_view = tensors
        (first, first_maps), (second, second_maps) = self.model(plain), self.model(seen)
        loss = self.alpha * vicreg(first, second)
        if self.alpha < 1:
            there = centres(self.tiles.tile_px, self.model.side).to(plain.device)
            moved = there @ tile_from_view[..., :2].mT + tile_from_view[:, None, :, 2]
            whole = there.expand(len(plain), -1, -1)
            loss = loss + (1 - self.alpha) * local_vicreg(first_maps, second_maps, whole, moved)
        torch.autograd.backward(loss * scale)
        return loss.detach()


def centres(tile_px: int, side: int) -> Tensor:
    """Centres (side * side, 2) of the cells of a feature map, x and y in pixels of the tile."""
    at = (torch.arange(side) + 0.5) * (tile_px / side)
    y, x = torch.meshgrid(at, at, indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], dim=1)


def learn_caevl(
    recipe: CaevlRecipe,
    tiles: SheetTiles,
    represent: Represent,
    *,
    binary: bool,
    seed: int,
    work: Path | None,
    report: Progress,
    means: Means,
) -> TrainedNetwork:
    """The fine-tuned encoder, with its ONNX embedder checked against PyTorch.

    `represent`: function from grey levels to what the tiles show. The others, and what is raised,
    are as in `learn_network`; both trainings resume.
    """
    share = recipe.epochs / (recipe.epochs + recipe.tuning_epochs)
    first = learn_network(
        recipe.first(),
        tiles,
        binary=binary,
        seed=seed,
        work=None if work is None else work / FIRST,
        report=lambda text, done: report(f"auto-encoder: {text}", share * done),
        means=means,
    )
    encoder = first.encoder
    assert isinstance(encoder, nn.Sequential)
    task = Tuning(recipe, tiles, encoder.to("cpu"), represent, seed)

    def tuning(text: str, done: float) -> None:
        report(f"fine-tuning: {text}", share + (1 - share) * done)

    Training(
        task, recipe.exchanged(), tiles, seed=seed, work=work, report=tuning, means=means
    ).run()
    return finished(encoder, recipe, tiles, tuning, means)
