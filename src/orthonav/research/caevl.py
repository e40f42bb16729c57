"""Learns CAEVL: the auto-encoder of the paper, then its encoder fine-tuned on augmented tiles.

Amadei et al., WACV 2026 (arXiv 2512.02737): "An autoencoder is trained using a pixel-wise L2 loss
and a perceptual loss. The decoder is then discarded and the encoder is fine-tuned using a
non-contrastive approach": VICReg on the embeddings of a tile and of the same tile augmented, and on
their feature maps before the dense layer, through projection heads that are discarded. The encoder
has the five strided convolutions of `orthonav.research.autoencoder`. Not as there: the perceptual
loss, which needs DINOv2, is left out; LeakyReLU has the slope of our auto-encoder; heads are
normalized as there (batch norm), and there is no validation set that would stop a training early.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from orthonav.core.files import Progress
from orthonav.research.augment import Augmented, augmented
from orthonav.research.caevl_recipe import CaevlRecipe
from orthonav.research.export import export_encoder
from orthonav.research.means import Means, device_of, kept_memory, processes
from orthonav.research.tiles import SheetTiles
from orthonav.research.training import (
    CALIBRATION_TILES,
    HELD_OUT_TILES,
    TrainedNetwork,
    learn_network,
    train,
)
from orthonav.research.vicreg import local_vicreg, vicreg

LOCAL_NUMBERS = 512
"""Numbers of the local projection head, over all of a feature map, as in the released code."""
FIRST = "autoencoder"
"""Folder of the auto-encoder's checkpoint, within that of the training."""

Represent = Callable[[NDArray[np.uint8], NDArray[np.bool_]], NDArray[np.float32]]


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
            made: Augmented = augmented(rng, self.tiles.grey_tile(int(index)))
            seen[row] = self.represent(made.grey, np.ones(made.grey.shape, np.bool_))
            places[row] = made.tile_from_view
        return plain, seen, places

    def backward(self, run: nn.Module, *tensors: Tensor, scale: Tensor) -> Tensor:
        """The weighted loss, after adding its gradients times `scale`."""
        plain, seen, tile_from_view = tensors
        (first, first_maps), (second, second_maps) = run(plain), run(seen)
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
    with kept_memory(means.keep_memory), processes(means) as world:
        task = Tuning(recipe, tiles, encoder.to("cpu"), represent, seed)
        train(
            task,
            recipe.exchanged(),
            tiles,
            seed=seed,
            work=work,
            report=lambda text, done: report(f"fine-tuning: {text}", share + (1 - share) * done),
            means=means,
            world=world,
        )
        device = device_of(means, world)
    taken, held = (_spread(len(tiles), count) for count in (CALIBRATION_TILES, HELD_OUT_TILES))
    made = export_encoder(encoder.to("cpu"), recipe, tiles.batch(taken), tiles.batch(held))
    return TrainedNetwork(made.embedder, encoder.to(device).eval(), device)


def _spread(count: int, wanted: int) -> NDArray[np.intp]:
    """Up to so many indices below `count`, evenly spread."""
    return np.unique(np.linspace(0, count - 1, wanted).astype(np.intp))
