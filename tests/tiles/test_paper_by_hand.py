"""Sentences and equations of Di Piazza et al. 2024 on cases small enough to work out by hand."""

import math

import numpy as np
import pytest

from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.confidence import Acceptance
from orthonav.core.localize.tiles import MAX_RATIO, TileMatcher, lowe_ratio
from orthonav.core.records import Fix
from orthonav.core.tiles.network import AutoEncoderRecipe, TripletRecipe
from orthonav.core.tiles.represent import Canny
from orthonav.core.tiles.words import WordsEmbedder, WordsRecipe

# Dataset: tiles of the search band.


@pytest.mark.parametrize("overlap, step_m", [(0.875, 32 * 0.2), (0.995, 0.2)])
def test_overlaps_of_table_1_are_steps_of_whole_pixels(overlap, step_m):
    """256 px x 0.125 = 32 px; 256 px x 0.005 = 1.28 px, rounded to 1."""
    grid = TileGrid.covering((0, 0, 150, 10), gsd_m=0.2, tile_px=256, overlap=overlap)
    assert grid.stride_m == step_m


def test_rows_of_a_band_go_south_and_columns_east():
    """96 m x 64 m at 1 m per pixel: two rows of three tiles, 32 m apart."""
    grid = TileGrid.covering((0, 0, 96, 64), gsd_m=1, tile_px=256, overlap=0.875)
    assert (grid.rows, grid.cols, grid.stride_m, grid.tile_m) == (2, 3, 32, 256)
    centres = grid.centres_en_m(np.array([[0, 0], [0, 2], [1, 0]]))
    assert centres.tolist() == [[16, 48], [80, 48], [16, 16]]


# Methodology: edges.


@pytest.mark.parametrize(
    "steps, edge", [((50, 50), 0), ((51, 51), 1), ((51, 26), 1), ((51, 25), 0)]
)
def test_canny_has_thresholds_of_100_and_200(steps, edge):
    """Sobel's gradient is 4 x a step: 4 x 50 and 4 x 25 are not above 200 and 100."""
    grey = np.zeros((16, 16), np.uint8)
    grey[:8, 8:], grey[8:, 8:] = steps
    assert Canny()(grey, np.ones(grey.shape, bool))[0, 13].any() == edge


# Related work: similarity and position.


def words(descriptors, similarity="product"):
    """Frequencies of words: number i is the word of 128 numbers i."""
    vocabulary = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 128, axis=1)
    found = np.repeat(np.array(descriptors, np.float32)[:, None], 128, axis=1)
    features = np.zeros((len(found), 2), np.float32), np.zeros(len(found), np.float32), found
    recipe = WordsRecipe(words=256, similarity=similarity)
    embedder = WordsEmbedder(recipe, vocabulary, np.zeros(0, np.float32), lambda grey: features)
    return embedder.view(np.zeros((1, 8, 8), np.float32), np.ones((8, 8), bool))


def test_a_bag_of_words_counts_the_features_of_each_cluster():
    made = words([10, 10.4, 12, 200])
    assert made[[10, 12, 200]].tolist() == [0.5, 0.25, 0.25] and made.sum() == 1


def matched(embeddings, query, position="best"):
    """Best tile and position east of a row of tiles at 16, 48, .. m."""
    tiles = np.array(embeddings, np.float16)
    grid = TileGrid.covering((0, 0, 32 * len(tiles), 32), gsd_m=1, tile_px=256, overlap=0.875)
    rows_cols = np.stack([np.zeros(len(tiles), int), np.arange(len(tiles))], axis=1)
    centres = grid.centres_en_m(rows_cols).astype(np.float32)
    match = TileMatcher(grid, centres, tiles, position).match(np.array([query], np.float32))
    return match, float(centres[match.tile, 0]) + match.shift_en_m[0]


@pytest.mark.parametrize("similarity, best, score", [("product", 0, 0.6), ("cosine", 1, 0.98)])
def test_scalar_product_and_cosine_prefer_vectors_of_other_lengths(similarity, best, score):
    """Tiles (1, 0) and (0.5, 0.5), view (0.6, 0.4): products 0.6 and 0.5, cosines 0.83 and 0.98."""
    tiles = [words([7, 7], similarity), words([7, 9], similarity)]
    match, _ = matched(tiles, words([7, 7, 7, 9, 9], similarity))
    assert match.tile == best and match.evidence["score"] == pytest.approx(score, abs=1e-3)


@pytest.mark.parametrize("scores, best_m, mean_m", [([1, 3, 4], 80, 60), ([-5, 3, 1], 48, 56)])
def test_best_tile_and_weighted_mean(scores, best_m, mean_m):
    """(16 + 3 x 48 + 4 x 80) / 8 = 60; without negative weights, (3 x 48 + 80) / 4 = 56."""
    embeddings = [[score] for score in scores]
    assert matched(embeddings, [1], "best")[1] == best_m
    assert matched(embeddings, [1], "weighted")[1] == pytest.approx(mean_m)


# Methodology: confidence criterion, equation 3.

RATIOS = [
    *[((0.5, 1.0, 0.25), 2.0), ((1.0, 0.01), MAX_RATIO), ((1.0, -0.5), MAX_RATIO)],
    *[((-0.5, -0.25), 1.0), ((0.5,), MAX_RATIO), ((), MAX_RATIO)],
]


@pytest.mark.parametrize("scores, ratio", RATIOS)
def test_lowes_ratio_is_best_over_second_best(scores, ratio):
    assert lowe_ratio(np.array(scores, np.float32)) == ratio


@pytest.mark.parametrize("scores, accepted", [((113, 100, 99), True), ((1129, 1000), False)])
def test_a_ratio_of_1_13_is_accepted_and_none_below(scores, accepted):
    evidence = matched([[score] for score in scores], [1])[0].evidence
    fix = Fix(0.0, 0.0, np.eye(2), math.nan, 15.0, 0.0, 2000.0, evidence)
    assert Acceptance.parse("lowe_ratio:1.13").accepts(fix) == accepted


# Networks: equations 1 and 2.


def test_networks_have_the_papers_sizes_and_trainings():
    import torch

    from orthonav.research.autoencoder import AutoEncoder
    from orthonav.research.triplet import ResNet34

    one, other = AutoEncoderRecipe(), TripletRecipe()
    assert (one.dims, one.epochs, one.batch, one.learning_rate) == (1024, 200, 32, 3e-4)
    assert (other.dims, other.epochs, other.batch, other.learning_rate) == (1024, 200, 512, 1e-3)
    with torch.device("meta"):
        models = AutoEncoder(width=one.width, dims=one.dims), ResNet34(width=other.width)
    counts = [sum(values.numel() for values in model.parameters()) for model in models]
    assert counts == [172_506_561, 21_278_400]


def test_reconstruction_loss_of_four_pixels():
    """(0.5^2 + 0 + 0 + 1^2) / 4: equation 1 over the number of pixels."""
    import torch

    from orthonav.research.autoencoder import reconstruction_loss

    tile, made = torch.tensor([[[[0.0, 1], [1, 0]]], [[[0.5, 1], [1, 1]]]])
    assert float(reconstruction_loss(tile[None], made[None])) == 0.3125


@pytest.mark.parametrize("margin, loss", [(1, 0), (3, 0), (4, 1)])
def test_triplet_loss_of_three_embeddings(margin, loss):
    """Positive 1 away, negative 2 away: max(0, 1 - 4 + margin)."""
    import torch

    from orthonav.research.triplet import triplet_loss

    anchor, positive, negative = torch.tensor([[0.0, 0], [1, 0], [0, 2]])
    apart = torch.tensor([[False, True], [False, False]])  # the second has no negative
    anchors, positives = torch.stack([anchor, negative]), torch.stack([positive, negative])
    assert float(triplet_loss(anchors, positives, apart, margin=margin, semi_hard=False)) == loss


def test_words_are_the_centres_of_clusters():
    """Of descriptors 0, 2, 10 and 12: the means 1 and 11."""
    from orthonav.research import words as learning

    faiss = pytest.importorskip("faiss")
    drawn = np.array([[0], [2], [10], [12]], np.float32)
    centres = learning._clustered(faiss, drawn, 2, 0, lambda share: None)
    assert sorted(centres.ravel().tolist()) == [1, 11]


@pytest.mark.parametrize(
    "recipe, kind, later", [(AutoEncoderRecipe(), "AdamW", 1.5e-4), (TripletRecipe(), "Adam", 1e-3)]
)
def test_the_rate_of_the_auto_encoder_is_halved_on_a_plateau(recipe, kind, later):
    """ "AdamW", "ReduceLROnPlateau [..] with a factor of 0.5", "Adam"; the loss does not fall."""
    import torch

    from orthonav.research.training import TrainingState

    state = TrainingState(torch.nn.Linear(1, 1), recipe, torch.amp.GradScaler(enabled=False))
    for _ in range(12):
        state.end_epoch(0.5)
    assert type(state.optimizer).__name__ == kind
    assert state.optimizer.param_groups[0]["lr"] == pytest.approx(later)
