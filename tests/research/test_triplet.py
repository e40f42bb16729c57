"""The triplet network is the paper's ResNet34; loss and mining equal those of a slow loop."""

import numpy as np
import pytest
import torch

from orthonav.core.tiles.network import TripletRecipe
from orthonav.research.tiles import SheetTiles
from orthonav.research.triplet import ResNet34, Triplets, triplet_loss


@pytest.mark.parametrize("tile_px", [32, 64, 96, 100])
def test_channels_are_averaged_over_the_left_and_the_right_half(tile_px):
    model = ResNet34(tile_px=tile_px, width=2).eval()
    tiles = torch.rand(2, 1, tile_px, tile_px)
    features = model.blocks(model.stem(tiles))
    width = features.shape[-1]
    left = features[..., : (width + 1) // 2].mean((2, 3))
    right = features[..., width // 2 :].mean((2, 3))
    torch.testing.assert_close(model(tiles), torch.stack([left, right], 2).flatten(1))


def batch(seed, count=7, dims=3):
    rng = np.random.default_rng(seed)
    anchors = rng.normal(size=(count, dims))
    positives = anchors + 0.7 * rng.normal(size=(count, dims))
    apart = rng.random((count, count)) > 0.3
    return anchors, positives, apart & apart.T & ~np.eye(count, dtype=bool)


def slow_loss(anchors, positives, apart, margin, semi_hard):
    """The paper's formula, one anchor after the other."""
    losses = []
    for row, anchor in enumerate(anchors):
        near = ((anchor - positives[row]) ** 2).sum()
        far = [((anchor - anchors[col]) ** 2).sum() for col in np.flatnonzero(apart[row])]
        if not far:
            continue
        beyond = [distance for distance in far if distance > near]
        chosen = min(beyond) if semi_hard and beyond else min(far)
        losses.append(max(0, near - chosen + margin))
    return np.mean(losses) if losses else 0.0


@pytest.mark.parametrize("semi_hard", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_the_loss_equals_the_formula(seed, semi_hard):
    anchors, positives, apart = batch(seed)
    tensors = [torch.from_numpy(values) for values in (anchors, positives, apart)]
    for margin in (0.2, 5.0):
        made = triplet_loss(*tensors, margin=margin, semi_hard=semi_hard)
        wanted = slow_loss(anchors, positives, apart, margin, semi_hard)
        assert float(made) == pytest.approx(wanted, rel=1e-5, abs=1e-7)


def test_places_that_are_not_apart_are_not_negatives():
    vectors = torch.rand(4, 3, requires_grad=True)
    apart = torch.zeros(4, 4, dtype=torch.bool)
    loss = triplet_loss(vectors, vectors + 1, apart, margin=1.0, semi_hard=False)
    loss.backward()
    assert float(loss.detach()) == 0
    assert float(vectors.grad.abs().max()) == 0


def sheet(tile_px=32, count=6):
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (1, 64, 192), dtype=np.uint8)
    tiles_px = np.array([[at % 2, 8 * at] for at in range(count)])
    return SheetTiles(pixels, np.ones((64, 192), bool), tiles_px, tile_px)


def task(positive, chunk=64, **recipe):
    torch.manual_seed(0)
    return Triplets(TripletRecipe(width=1, **recipe), sheet(), positive, seed=3, chunk=chunk)


def test_positives_depend_on_seed_epoch_and_tile_only():
    noisy = task(lambda rng, grey: rng.integers(0, 256, grey.shape, dtype=np.uint8))
    both, _ = noisy.arrays(0, np.array([4, 1]))
    again, _ = noisy.arrays(0, np.array([0, 1, 4]))
    np.testing.assert_array_equal(both[0::2], noisy.tiles.batch(np.array([4, 1])))
    np.testing.assert_array_equal(both[1], again[5])
    later, _ = noisy.arrays(1, np.array([4, 1]))
    assert (later[1] != both[1]).mean() > 0.9


def test_positives_may_be_another_date_or_a_representation():
    other = SheetTiles(
        255 - sheet().pixels, sheet().valid, sheet().tiles_px, 32, scale=sheet().scale
    )
    both, _ = task([other]).arrays(0, np.arange(3))
    np.testing.assert_allclose(both[0::2] + both[1::2], 1, atol=1e-6)
    as_float = task(lambda rng, grey: (grey / 255).astype(np.float32)[None])
    both, _ = as_float.arrays(0, np.arange(3))
    np.testing.assert_allclose(both[0::2], both[1::2], atol=1e-6)
    with pytest.raises(ValueError, match="positive must be"):
        task(lambda rng, grey: grey[1:]).arrays(0, np.arange(3))


def test_neighbours_with_a_large_overlap_are_not_apart():
    _, apart = task([sheet()], apart=0.5).arrays(0, np.array([0, 1, 3]))
    assert apart.tolist() == [[False, False, True], [False, False, True], [True, True, False]]
    _, apart = task([sheet()], apart=0.0).arrays(0, np.array([2, 2, 3]))
    assert apart.tolist() == [[False, False, True], [False, False, True], [True, True, False]]


@pytest.mark.parametrize("similarity", ["product", "cosine"])
def test_a_batch_in_chunks_has_the_gradients_of_the_whole(similarity):
    """With batch norms in evaluation mode: in training they use chunks."""
    gradients = []
    for chunk in (64, 4):
        one = task([sheet()], chunk, similarity=similarity)
        one.model.eval()
        both, apart = (torch.from_numpy(values) for values in one.arrays(0, np.arange(6)))
        both[1::2] += 0.3 * torch.rand(both[1::2].shape, generator=torch.Generator().manual_seed(0))
        loss = one.backward(both, apart, scale=torch.ones(()))
        assert float(loss) > 0
        gradients.append([values.grad for values in one.model.parameters()])
    largest = max(float(values.abs().max()) for values in gradients[0])
    assert largest > 0
    for whole, chunked in zip(*gradients, strict=True):
        torch.testing.assert_close(chunked, whole, rtol=1e-3, atol=1e-5 * largest)
