"""Edges between dates: what is learnt is what the file gives, and it prefers what stays."""

import hashlib

import numpy as np
import pytest
import torch
from experiments.paper import between_dates as between
from experiments.paper.methods import BETWEEN_DATES

from orthonav.core.tiles.learned import LearnedEdges


def dates(seed=0, size=150):
    """Two dates of fields with the same borders, each with stripes of its own."""
    rng = np.random.default_rng(seed)
    fields = np.kron(rng.integers(0, 5, (5, 5)), np.ones((30, 30)))[:size, :size] * 40
    y, x = np.mgrid[:size, :size]
    stripes = [((y // 3) % 2) * 30, ((x // 3) % 2) * 30]
    return [np.clip(fields + each, 0, 255).astype(np.uint8) for each in stripes]


def test_the_margin_is_what_the_convolutions_take():
    model, size = between.network(), 64
    margin = between.margin_px(model)
    side = size + 2 * margin
    assert model(torch.zeros(1, 1, side, side)).shape == (1, 1, size, size)


@pytest.mark.slow  # an experiment
def test_what_is_learnt_is_what_flies(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(between, "PAIRS", 1)
    monkeypatch.setattr(between, "CROP_PX", 64)
    areas = [dates(seed) for seed in range(2)]
    model = between.learn(areas, steps=4)
    assert "step 4 of 4" in capsys.readouterr().out
    shares = [np.mean(between.logits(model, grey) > 0) for each in areas for grey in each]
    plain = [between.canny(grey).mean() for each in areas for grey in each]
    assert np.mean(shares) == pytest.approx(np.mean(plain), rel=0.02)
    path = tmp_path / "edges.onnx"
    between.write(model, path)
    first = path.read_bytes()
    between.write(model, path)
    assert path.read_bytes() == first
    edges = LearnedEdges(str(path))
    assert edges.margin_px == between.margin_px(model)
    grey = areas[0][0]
    expected = between.logits(model, grey)
    found = edges(grey, np.ones(grey.shape, bool))[0]
    clear = np.abs(expected) > 1e-4
    np.testing.assert_array_equal(found[clear] > 0, expected[clear] > 0)


def test_targets_are_edges_that_all_dates_have():
    flat, edged = np.full((60, 60), 90, np.uint8), np.full((60, 60), 90, np.uint8)
    edged[:, 30:] = 200
    both = edged.copy()
    both[40:] = 10  # at this date only
    assert not between.lasting([flat, edged]).any()
    found = between.lasting([edged, both])
    assert 0.9 < found[:30].max() <= 1 and not found[42:, :20].any()


@pytest.mark.slow  # an experiment
def test_a_batch_holds_the_same_ground_at_two_dates(monkeypatch):
    monkeypatch.setattr(between, "PAIRS", 3)
    monkeypatch.setattr(between, "CROP_PX", 32)
    rng = np.random.default_rng(1)
    ground = rng.integers(60, 160, (90, 90)).astype(np.uint8)
    for seen, wanted in between.batches([[ground, ground + 20]], 10, 4):
        assert (seen.shape, wanted.shape) == ((6, 1, 52, 52), (6, 1, 32, 32))
        torch.testing.assert_close(wanted[:3], wanted[3:])
        for one, other in zip(seen[:3], seen[3:], strict=True):  # another light, the same ground
            assert np.corrcoef(one.numpy().ravel(), other.numpy().ravel())[0, 1] > 0.9


def test_the_loss_falls_where_two_dates_agree():
    wanted = torch.zeros(2, 1, 40, 40)
    wanted[..., 20] = 1
    right = 8 * wanted - 4
    moved = right.clone()
    moved[1] = torch.roll(right[1], 10, dims=-1)
    assert between.correlation(right[:1], right[1:]) == pytest.approx(1, abs=1e-4)
    assert between.correlation(moved[:1], moved[1:]) < 0.1
    entropy = torch.nn.functional.binary_cross_entropy_with_logits
    gained = between.loss_of(moved, wanted) - between.loss_of(right, wanted)
    assert gained > entropy(moved, wanted) - entropy(right, wanted) + 0.4


def test_unrelated_edges_do_not_agree():
    rng = np.random.default_rng(0)
    one, other = (rng.random((2, 200, 200)) < 0.1).astype(np.uint8)
    assert between.agreement(one, one) == pytest.approx(1)
    assert abs(between.agreement(one, other)) < 0.05


def test_the_network_in_the_repository_flies():
    edges = LearnedEdges(str(BETWEEN_DATES))
    assert edges.sha256 == hashlib.sha256(BETWEEN_DATES.read_bytes()).hexdigest()
    assert edges.margin_px == between.margin_px(between.network())
    grey = dates()[0]
    everywhere = np.ones(grey.shape, bool)
    assert edges(grey, everywhere).mean() > 0.05
    assert not edges(np.full_like(grey, 120), everywhere).any()
