"""VICReg and its local form: what holds two views of a place together without negatives.

Bardes, Ponce and LeCun, "VICReg", ICLR 2022 (arXiv 2105.04906), algorithm 1; Bardes, Ponce and
LeCun, "VICRegL", NeurIPS 2022 (arXiv 2210.01571), section 3, for the local form.
"""

import torch
from torch import Tensor
from torch.nn import functional

INVARIANCE, VARIANCE, COVARIANCE = 25.0, 25.0, 1.0
"""Weights of the three terms, of VICReg and of CAEVL."""
LEAST_SPREAD, TINY = 1.0, 1e-4
"""Standard deviation that every number of an embedding is held at, and what keeps its root off
zero."""
BEST_MATCHES = (20, 4)
"""Pairs by place that are compared, from the tile to the view and back, as in VICRegL."""


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
