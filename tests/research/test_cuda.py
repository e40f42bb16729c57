"""Learning on a GPU: the same network up to rounding, in each precision; tiles embedded there."""

import dataclasses

import numpy as np
import pytest
import torch
from test_training import AUTO, TRIPLET, Killed, kill_at, losses, noisy, sheet

from orthonav.core.tiles.network import TripletRecipe
from orthonav.research import training
from orthonav.research.training import Means, learn_network

pytestmark = pytest.mark.skipif(
    not torch.cuda.is_available(), reason="needs a GPU that PyTorch sees"
)
GPU = Means(save_every_s=0, device="cuda")
BOTH = pytest.mark.parametrize("recipe", [AUTO, TRIPLET], ids=["autoencoder", "triplet"])


def trained(recipe, work, how=GPU, report=None):
    positive = noisy if isinstance(recipe, TripletRecipe) else None
    given = {"binary": False, "seed": 1, "work": work, "positive": positive}
    return learn_network(recipe, sheet(), means=how, report=report, **given)


@BOTH
def test_a_gpu_learns_what_a_cpu_learns(recipe, tmp_path):
    trained(recipe, tmp_path / "cpu", dataclasses.replace(GPU, device="cpu", bf16=False))
    trained(recipe, tmp_path / "gpu", dataclasses.replace(GPU, bf16=False))
    np.testing.assert_allclose(losses(tmp_path / "gpu"), losses(tmp_path / "cpu"), rtol=0.05)


@BOTH
@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16])
def test_mixed_precision_gives_nearly_the_same(recipe, kind, tmp_path, monkeypatch):
    trained(recipe, tmp_path / "plain", dataclasses.replace(GPU, bf16=False))
    monkeypatch.setattr(training, "mixed_precision", lambda *_: kind)
    trained(recipe, tmp_path / "mixed")
    plain, mixed = losses(tmp_path / "plain"), losses(tmp_path / "mixed")
    assert mixed != plain
    np.testing.assert_allclose(mixed, plain, rtol=0.15)


@BOTH
def test_an_interrupted_training_resumes_on_a_gpu(recipe, tmp_path):
    trained(recipe, tmp_path / "whole")
    with pytest.raises(Killed):
        trained(recipe, tmp_path / "killed", report=kill_at("epoch 2 of 3, loss"))
    trained(recipe, tmp_path / "killed")
    assert losses(tmp_path / "killed") == losses(tmp_path / "whole")


@BOTH
@pytest.mark.parametrize("similarity", ["product", "cosine"])
def test_tiles_are_embedded_on_the_gpu_as_in_flight(recipe, similarity, tmp_path):
    made = trained(dataclasses.replace(recipe, similarity=similarity), None)
    assert next(made.encoder.parameters()).is_cuda
    maps = sheet().batch(np.arange(20))
    flown = made.embedder.views(maps)
    np.testing.assert_allclose(made.views(maps), flown, atol=1e-3 * np.abs(flown).max())


def test_batches_are_pinned_and_made_by_many_threads():
    assert training.workers_of(GPU, torch.device("cuda")) >= 1
    task = training._task(AUTO, sheet(), binary=False, positive=None, seed=0, means=GPU)
    given = {"seed": 0, "work": None, "report": lambda text, share: None, "means": GPU}
    made = training.Training(task, AUTO, sheet(), **given)
    assert all(each.is_pinned() for each in made.batch(0, np.arange(4)))
    assert all(each.is_cuda for batch in made.batches(0) for each in batch)
