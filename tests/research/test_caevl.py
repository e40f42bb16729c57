"""CAEVL: its losses equal slow loops, augmented tiles show what they say, and it is learnt."""

import dataclasses

import numpy as np
import pytest
import torch
from test_training import TILE_PX, ground
from test_training import sheet as grey_sheet

from orthonav.core.errors import VariantError
from orthonav.core.tiles.embed import TABLE, embedder_of
from orthonav.core.tiles.represent import Canny
from orthonav.core.variants import variant_recipe
from orthonav.research import caevl
from orthonav.research.autoencoder import AutoEncoder
from orthonav.research.caevl import augmented, local_vicreg, vicreg
from orthonav.research.caevl_recipe import CaevlRecipe
from orthonav.research.training import Means

QUICK = Means(save_every_s=1e6, workers=1, device="cpu", bf16=False)
RECIPE = CaevlRecipe(
    dims=8, width=8, epochs=2, tuning_epochs=3, batch=8, projector=16,
    learning_rate=3e-3, tuning_rate=3e-3,
)  # fmt: skip


def sheet():
    grey = ground(3)
    edges = Canny()(grey, np.ones(grey.shape, bool)).astype(np.uint8)
    return dataclasses.replace(grey_sheet(grey), pixels=edges, scale=1.0, grey=grey)


def learn(work=None, recipe=RECIPE, report=lambda text, share: None):
    return caevl.learn_caevl(
        recipe, sheet(), Canny(), binary=True, seed=1, work=work, report=report, means=QUICK
    )


def slow_vicreg(first, second):
    """The three terms, number after number."""
    dims = first.shape[1]
    total = 25 * ((first - second) ** 2).mean()
    for values in (first, second):
        spread = np.sqrt(values.var(axis=0, ddof=1) + 1e-4)
        total += 25 * np.maximum(0, 1 - spread).mean() / 2
        covariance = np.cov(values.T)
        total += (
            sum(covariance[i, j] ** 2 for i in range(dims) for j in range(dims) if i != j) / dims
        )
    return total


def test_the_loss_is_that_of_a_slow_loop():
    first, second = np.random.default_rng(0).normal(size=(2, 7, 4))
    found = vicreg(torch.from_numpy(first), torch.from_numpy(second))
    assert float(found) == pytest.approx(slow_vicreg(first, second), rel=1e-5)


def test_features_are_compared_with_those_of_the_same_place():
    """A map displaced by a cell costs less where the places say so."""
    maps = torch.from_numpy(np.random.default_rng(0).normal(size=(6, 3, 4, 4))).float()
    moved = torch.roll(maps, 1, dims=3)
    places = caevl.centres(TILE_PX, 4).expand(6, -1, -1)
    aware = torch.roll(places.reshape(6, 4, 4, 2), 1, dims=2).reshape(6, 16, 2)
    assert local_vicreg(maps, moved, places, aware) < local_vicreg(maps, moved, places, places)


@pytest.mark.parametrize("seed", range(8))
def test_an_augmented_tile_shows_what_it_says(seed):
    """Its centre shows the brightness of the place in the tile, up to light: a mark is found."""
    y, x = np.mgrid[:64, :64] + 0.5
    matrix = augmented(np.random.default_rng(seed), np.zeros((64, 64), np.uint8)).tile_from_view
    corners = np.array([[0, 0], [64, 0], [0, 64], [64, 64]]) @ matrix[:, :2].T + matrix[:, 2]
    assert corners.min() >= -1e-3 and corners.max() <= 64 + 1e-3
    place = matrix[:, :2] @ [32, 32] + matrix[:, 2]
    mark = 250 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 18)
    seen = augmented(np.random.default_rng(seed), mark.astype(np.uint8)).grey.astype(float)
    weights = seen - seen.min()
    assert (weights * x).sum() / weights.sum() == pytest.approx(32, abs=0.7)
    assert (weights * y).sum() / weights.sum() == pytest.approx(32, abs=0.7)


@pytest.mark.long
def test_learning_and_what_flies(tmp_path):
    said = []
    trained = learn(tmp_path, report=lambda text, share: said.append((text, share)))
    assert {text.partition(":")[0] for text, _ in said} == {"auto-encoder", "fine-tuning"}
    assert [share for _, share in said] == sorted(share for _, share in said)
    embedded = trained.views(sheet().batch(np.arange(4)))
    np.testing.assert_allclose(np.linalg.norm(embedded, axis=1), 1, atol=1e-5)
    plain = variant_recipe(TABLE, RECIPE)
    flown = embedder_of(plain, lambda name, dtype, ndim: trained.embedder.onnx, 1)
    np.testing.assert_allclose(flown.views(sheet().batch(np.arange(4))), embedded, atol=1e-5)


@pytest.mark.slow  # auto-encoders resume in every run
def test_fine_tuning_changes_the_encoder_and_resumes(tmp_path):
    whole = learn(tmp_path / "whole").embedder.onnx
    shorter = dataclasses.replace(RECIPE, tuning_epochs=1)
    first = learn(tmp_path / "parts", shorter).embedder.onnx
    assert not np.array_equal(first, whole)
    assert np.array_equal(learn(tmp_path / "parts").embedder.onnx, whole)


def test_a_last_batch_of_one_tile_does_not_end_a_learning():
    heads = caevl.Heads(AutoEncoder(tile_px=64, width=8, dims=8).encoder, 64, 1, 16).train()
    assert [len(each) for each in heads(torch.zeros(1, 1, 64, 64))] == [1, 1]


@pytest.mark.parametrize(
    "fields",
    [{"tuning_epochs": 0}, {"tuning_rate": 2}, {"alpha": 1.5}, {"projector": 0}, {"batch": 1}],
)
def test_impossible_parameters_are_refused(fields):
    with pytest.raises(VariantError, match=next(iter(fields))):
        CaevlRecipe(**fields)
