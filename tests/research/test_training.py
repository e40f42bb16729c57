"""Learning: the loss falls, a kill changes nothing."""

import dataclasses
import functools
import json
import tempfile
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from orthonav.core.errors import OutputError
from orthonav.core.tiles.network import AutoEncoderRecipe, TripletRecipe
from orthonav.research import training
from orthonav.research.tiles import SheetTiles
from orthonav.research.training import Means, TrainingError, learn_network

TILE_PX = 32
AUTO = AutoEncoderRecipe(dims=16, width=16, epochs=3, batch=8, learning_rate=3e-3)
TRIPLET = TripletRecipe(width=2, epochs=3, batch=8, mining="semihard", apart=0.5)
QUICK = Means(save_every_s=0, workers=1, device="cpu")
RARELY_SAVED = dataclasses.replace(QUICK, save_every_s=1e6)


def ground(seed=0, size=128):
    rng = np.random.default_rng(seed)
    blots = cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), 4)
    return np.clip(128 + 60 * blots / blots.std(), 0, 255).astype(np.uint8)


def sheet(grey=None):
    grey = ground() if grey is None else grey
    rows, cols = np.meshgrid(np.arange(0, 97, 24), np.arange(0, 97, 24), indexing="ij")
    tiles_px = np.stack([rows.ravel(), cols.ravel()], axis=1)
    return SheetTiles(grey[None], np.ones(grey.shape, bool), tiles_px, TILE_PX)


def noisy(rng, grey):
    return np.clip(grey * 0.8 + rng.normal(20, 8, grey.shape), 0, 255).astype(np.uint8)


def learn(recipe, work=None, tiles=None, means=QUICK, seed=1, report=None):
    positive = noisy if isinstance(recipe, TripletRecipe) else None
    given = {"seed": seed, "work": work, "means": means, "report": report, "positive": positive}
    return learn_network(recipe, tiles or sheet(), binary=False, **given).embedder


def losses(work):
    return json.loads((work / "history.json").read_text())["loss"]


@functools.cache
def undisturbed(recipe):
    """What a training without interruption gives, and its losses."""
    with tempfile.TemporaryDirectory() as folder:
        return SimpleNamespace(onnx=learn(recipe, Path(folder)).onnx, losses=losses(Path(folder)))


class Killed(Exception):
    """Stands for a signal that ends the process."""


def kill_at(beginning):
    """Progress callback that raises `Killed` at the first message that starts with `beginning`."""

    def report(text, share):
        if text.startswith(beginning):
            raise Killed

    return report


@pytest.mark.long
def test_the_auto_encoder_learns_to_reconstruct_the_area(tmp_path):
    messages = []
    learn(
        dataclasses.replace(AUTO, epochs=25),
        tmp_path,
        means=RARELY_SAVED,
        report=lambda text, share: messages.append((text, share)),
    )
    history = losses(tmp_path)
    assert len(history) == 25
    assert history[-1] < 0.3 * history[0]
    epochs = [share for text, share in messages if text.startswith("epoch")]
    assert epochs == pytest.approx(np.arange(1, 26) / 25)
    assert "float32" in messages[-1][0]


@pytest.mark.long
@pytest.mark.parametrize(
    "recipe",
    [AUTO, pytest.param(TRIPLET, marks=pytest.mark.slow)],
    ids=["autoencoder", "triplet"],
)
def test_an_interrupted_training_resumes_with_the_same_result(recipe, tmp_path):
    whole = undisturbed(recipe)
    with pytest.raises(Killed):
        learn(recipe, tmp_path / "killed", report=kill_at("epoch 2 of 3, loss"))
    assert len(losses(tmp_path / "killed")) == 1
    resumed = learn(recipe, tmp_path / "killed")
    np.testing.assert_array_equal(resumed.onnx, whole.onnx)
    assert losses(tmp_path / "killed") == whole.losses
    np.testing.assert_array_equal(learn(recipe, tmp_path / "killed").onnx, whole.onnx)


@pytest.mark.parametrize(
    ("recipe", "at"),
    [
        (AUTO, "epoch 1 of 3, batch 2"),
        pytest.param(TRIPLET, "epoch 2 of 3, batch 3", marks=pytest.mark.slow),
    ],
    ids=["autoencoder", "triplet"],
)
def test_a_training_killed_within_an_epoch_resumes_within_it(recipe, at, tmp_path, monkeypatch):
    whole = undisturbed(recipe)
    monkeypatch.setattr(training, "PROGRESS_EVERY_S", 0)
    with pytest.raises(Killed):
        learn(recipe, tmp_path / "killed", report=kill_at(at))
    half = tmp_path / "killed" / ".checkpoint.pt.x.tmp.pt"
    half.write_bytes(b"of a write that was killed")
    messages = []
    resumed = learn(recipe, tmp_path / "killed", report=lambda text, share: messages.append(text))
    assert messages[0].startswith(at) and not half.exists()
    np.testing.assert_array_equal(resumed.onnx, whole.onnx)
    assert losses(tmp_path / "killed") == whole.losses


def test_epochs_can_be_added_to_a_finished_training_and_not_taken_away(tmp_path):
    learn(dataclasses.replace(AUTO, epochs=2), tmp_path)
    np.testing.assert_array_equal(learn(AUTO, tmp_path).onnx, undisturbed(AUTO).onnx)
    assert losses(tmp_path) == undisturbed(AUTO).losses
    with pytest.raises(OutputError, match="of 3 epochs, 2 are asked"):
        learn(dataclasses.replace(AUTO, epochs=2), tmp_path)


def test_the_same_seed_gives_the_same_bytes_and_another_does_not():
    first, second, other = (learn(AUTO, seed=seed).onnx for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, other)


def test_pictures_show_the_progress(tmp_path):
    learn(AUTO, tmp_path)
    tiles = cv2.imread(str(tmp_path / "tiles.png"), cv2.IMREAD_GRAYSCALE)
    assert tiles.shape == (2 * TILE_PX, 6 * TILE_PX)
    np.testing.assert_allclose(tiles[:TILE_PX, :TILE_PX], sheet().grey_tile(0), atol=1)
    assert cv2.imread(str(tmp_path / "loss.png")).shape == (360, 640, 3)
    assert {path.name for path in tmp_path.iterdir()} == {
        "checkpoint.pt",
        "history.json",
        "loss.png",
        "tiles.png",
    }


def test_a_folder_of_another_training_is_refused(tmp_path):
    once = dataclasses.replace(AUTO, epochs=1)
    learn(once, tmp_path)
    before = (tmp_path / "checkpoint.pt").read_bytes()
    for change in (
        {"recipe": dataclasses.replace(once, learning_rate=1e-3)},
        {"seed": 2},
        {"tiles": sheet(ground(7))},
    ):
        with pytest.raises(OutputError, match="another training"):
            learn(**{"recipe": once, "work": tmp_path, **change})
    assert (tmp_path / "checkpoint.pt").read_bytes() == before


def test_a_finished_training_is_exported_in_another_precision(tmp_path):
    plain = learn(AUTO, tmp_path)
    messages, smaller = [], dataclasses.replace(AUTO, precision="float16")
    small = learn(smaller, tmp_path, report=lambda text, share: messages.append(text))
    # Nothing was trained again.
    assert len(messages) == 2 and messages[1].startswith("export: float16")
    assert small.recipe.precision == "float16" and small.onnx.nbytes < 0.6 * plain.onnx.nbytes


def test_a_folder_trained_with_other_dates_is_refused(tmp_path):
    recipe = dataclasses.replace(TRIPLET, epochs=1)
    given = {"binary": False, "seed": 0, "work": tmp_path, "means": QUICK}
    learn_network(recipe, sheet(), positive=[sheet(ground(1))], **given)
    learn_network(recipe, sheet(), positive=[sheet(ground(1))], **given)
    with pytest.raises(OutputError, match="another training"):
        learn_network(recipe, sheet(), positive=[sheet(ground(2))], **given)


def test_a_broken_checkpoint_is_refused_and_runs_no_code(tmp_path):
    (tmp_path / "checkpoint.pt").write_bytes(b"broken")
    with pytest.raises(OutputError, match="cannot be read"):
        learn(AUTO, tmp_path)
    torch.save({"fingerprint": Killed}, tmp_path / "checkpoint.pt")
    with pytest.raises(OutputError, match="cannot be read"):
        learn(AUTO, tmp_path)


def test_a_loss_that_is_not_finite_ends_the_training():
    def unknown(rng, grey):
        return np.full((1, *grey.shape), np.nan, np.float32)

    given = {"binary": False, "seed": 0, "work": None, "means": QUICK}
    with pytest.raises(TrainingError, match="learning_rate"):
        learn_network(TRIPLET, sheet(), positive=unknown, **given)


def test_triplets_need_positives():
    with pytest.raises(ValueError, match="positives"):
        learn_network(TRIPLET, sheet(), binary=False, seed=0, work=None, means=QUICK)


def test_scaled_gradients_give_the_same_result(tmp_path, monkeypatch):
    """What float16 needs: gradients times 65536, and divided by it before the step."""
    original = torch.amp.GradScaler
    monkeypatch.setattr(
        training.torch.amp, "GradScaler", lambda device, enabled: original(device, enabled=True)
    )
    learn(AUTO, tmp_path)
    monkeypatch.undo()
    np.testing.assert_allclose(losses(tmp_path), undisturbed(AUTO).losses, rtol=1e-3)


@pytest.mark.parametrize("recipe", [AUTO, TRIPLET], ids=["autoencoder", "triplet"])
def test_tensors_stay_contiguous(recipe, monkeypatch):
    """In `channels_last` oneDNN gives wrong gradients for narrow shortcuts, or crashes: so each
    convolution is checked before it runs."""
    layers, convolve = set(), torch.nn.Conv2d.forward

    def checked(layer, values):
        assert values.is_contiguous() and layer.weight.is_contiguous()
        layers.add(layer)
        return convolve(layer, values)

    monkeypatch.setattr(torch.nn.Conv2d, "forward", checked)
    learn(dataclasses.replace(recipe, epochs=1))
    assert layers
