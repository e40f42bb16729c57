"""Bags of visual words: frequencies of known features, and places distinguished by them."""

import cv2
import numpy as np
import pytest

from helpers import textured
from orthonav.core.errors import VariantError
from orthonav.core.tiles.represent import Gray
from orthonav.core.tiles.words import WordsEmbedder, WordsRecipe, describe
from orthonav.core.variants import Variant
from orthonav.research.words import SheetWords, learn_words

TABLE = {"bovw": Variant("orthonav.core.tiles.words:WordsRecipe")}
NOTHING = np.zeros(0, np.float32)
AREA = textured((700, 700))


def tiles(grey, size=128, step=96):
    starts = range(0, grey.shape[0] - size + 1, step)
    return [grey[y : y + size, x : x + size] for y in starts for x in starts]


def pictures_of(greys):
    """Pictures that are valid everywhere, as `learn_words` takes them."""
    return [(grey, everywhere(grey)) for grey in greys]


def everywhere(grey):
    return np.ones(grey.shape, bool)


def maps_of(grey):
    return Gray()(grey, everywhere(grey))


def random_embedder(words=300, seed=0, tfidf=0, **parameters):
    rng = np.random.default_rng(seed)
    vocabulary = rng.integers(0, 120, (words, 128), dtype=np.uint8)
    idf = rng.uniform(0.1, 5, words).astype(np.float32) if tfidf else NOTHING
    return WordsEmbedder(WordsRecipe(words=words, tfidf=tfidf, **parameters), vocabulary, idf)


@pytest.fixture(scope="module")
def learnt():
    return learn_words(WordsRecipe(words=256), pictures_of(tiles(AREA)), seed=1)


def test_features_are_opencvs_sift():
    grey = tiles(AREA)[0]
    _, expected = cv2.SIFT.create(nfeatures=2000).detectAndCompute(grey, None)
    np.testing.assert_array_equal(describe(WordsRecipe(), grey, everywhere(grey)), expected)


@pytest.mark.parametrize("words", [256, 2000])
def test_assignment_is_exact(words):
    """Whole numbers: the same as OpenCV's exhaustive search, ties included."""
    embedder = random_embedder(words)
    rng = np.random.default_rng(1)
    descriptors = rng.integers(0, 180, (5000, 128)).astype(np.float32)
    matches = cv2.BFMatcher(cv2.NORM_L2).match(descriptors, embedder.vocabulary.astype(np.float32))
    distances = np.array([match.distance for match in matches]) ** 2
    found = embedder.assigned(descriptors)
    own = np.square(descriptors - embedder.vocabulary[found].astype(np.float32)).sum(axis=1)
    np.testing.assert_allclose(own, distances, rtol=1e-5)
    np.testing.assert_array_equal(found[4090:4100], embedder.assigned(descriptors[4090:4100]))


@pytest.mark.parametrize("similarity", ["product", "cosine"])
@pytest.mark.parametrize("tfidf", [0, 1])
def test_views_without_features_are_zero(similarity, tfidf):
    embedder = random_embedder(similarity=similarity, tfidf=tfidf)
    for grey in (np.full((128, 128), 90, np.uint8), np.zeros((16, 16), np.uint8)):
        assert not embedder.view(maps_of(grey), everywhere(grey)).any()
    grey = tiles(AREA)[0]
    blind = embedder.view(maps_of(grey), np.zeros(grey.shape, bool))
    assert not blind.any() and np.isfinite(blind).all()


def test_features_that_see_invalid_pixels_are_dropped():
    """What lies there has no influence, and its border gives no features."""
    grey = tiles(AREA, size=192)[0]
    valid = everywhere(grey)
    valid[:, 86:] = False
    recipe = WordsRecipe()
    painted = np.where(valid, grey, 255).astype(np.uint8)
    kept, other = describe(recipe, grey, valid), describe(recipe, painted, valid)
    np.testing.assert_array_equal(kept, other)
    assert 0.2 < len(kept) / len(describe(recipe, grey, everywhere(grey))) < 0.5
    flat = np.where(valid, np.uint8(40), np.uint8(220))
    assert len(describe(recipe, flat, valid)) == 0


# Learning.


def test_places_are_found_again(learnt):
    """Views between the tiles, turned by 8 degrees and darker: the nearest tile is most alike."""
    grey = AREA
    reference = learnt.views(np.stack([maps_of(tile) for tile in tiles(grey)]))
    starts = [(y, x) for y in range(0, 573, 96) for x in range(0, 573, 96)]
    turn = cv2.getRotationMatrix2D((349.5, 349.5), 8, 1)
    turned = (cv2.warpAffine(grey, turn, (700, 700)) * 0.8).astype(np.uint8)
    right = 0
    rng = np.random.default_rng(0)
    for _ in range(10):
        centre = rng.uniform(220, 480, 2)  # x, y in the turned picture
        x, y = np.rint(centre - 64).astype(int)
        view = turned[y : y + 128, x : x + 128]
        scores = reference @ learnt.view(maps_of(view), everywhere(view))
        place = cv2.invertAffineTransform(turn) @ [x + 63.5, y + 63.5, 1]
        best = np.array(starts[int(scores.argmax())])[::-1] + 63.5
        right += np.abs(best - place).max() <= 64
    assert right >= 8


@pytest.mark.parametrize("block_px", [400, 1024])
def test_words_of_a_tile_are_those_of_the_sheet_within_it(learnt, monkeypatch, block_px):
    """But for the few whose surroundings the edge of the tile cuts."""
    monkeypatch.setattr("orthonav.research.words.BLOCK_PX", block_px)
    grey, corners = AREA, np.array([[96, 192], [500, 11]])
    shares = []
    found = SheetWords.find(learnt, grey, everywhere(grey), shares.append)
    assert shares[-1] == 1 and len(shares) == (4 if block_px == 400 else 1)
    for (row, col), sheet in zip(corners, found.views(corners, 192), strict=True):
        tile = grey[row : row + 192, col : col + 192]
        alone = learnt.view(maps_of(tile), everywhere(tile))
        assert sheet.sum() == pytest.approx(1) and np.minimum(sheet, alone).sum() > 0.85


def test_words_of_a_tile_are_those_of_its_strongest_features(learnt):
    grey, recipe = AREA, WordsRecipe(words=256, max_features=20)
    few = WordsEmbedder(recipe, learnt.vocabulary, NOTHING)
    valid = everywhere(grey)
    valid[:, 300:] = False
    found = SheetWords.find(few, grey, valid, lambda share: None)
    (view,) = found.views(np.array([[96, 100]]), 192)
    np.testing.assert_array_equal(view * 20, np.rint(view * 20))
    assert view.sum() == pytest.approx(1) and found.points[:, 0].max() < 300


@pytest.mark.parametrize("greys", [[], [np.zeros((64, 64), np.uint8)], [textured((100, 100))]])
def test_too_few_features_are_refused(greys):
    with pytest.raises(VariantError, match=r"1024 words cannot be learned from \d+ features"):
        learn_words(WordsRecipe(), pictures_of(greys))
