"""Segment Anything boundaries: known masks, and the true architecture with small random weights."""

import json
import pickle
import re
import shutil

import cv2
import numpy as np
import pytest
import torch
import transformers

from orthonav.core.errors import MissingFileError, VariantError
from orthonav.core.geo.camera import Camera
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import Telemetry, View
from orthonav.core.variants import Variant, make_variant
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.research import sam
from orthonav.research.sam import SamBoundaries, automatic_masks, boundary_map, suppressed

SIDE = 64
TABLE = {"sam": Variant("orthonav.research.sam:SamBoundaries", flies=False, extra="train")}
# Names in the published checkpoints, for a model of two blocks and two decoder layers.
ORIGINAL_NAMES = [
    (r"^vision_encoder\.", "image_encoder."),
    (r"patch_embed\.projection", "patch_embed.proj"),
    (r"^(image_encoder)\.layers\.", r"\1.blocks."),
    (r"neck\.conv1", "neck.0"),
    (r"neck\.layer_norm1", "neck.1"),
    (r"neck\.conv2", "neck.2"),
    (r"neck\.layer_norm2", "neck.3"),
    (r"shared_embedding\.positional_embedding", "pe_layer.positional_encoding_gaussian_matrix"),
    (r"\.point_embed\.", ".point_embeddings."),
    (r"mask_embed\.conv1", "mask_downscaling.0"),
    (r"mask_embed\.layer_norm1", "mask_downscaling.1"),
    (r"mask_embed\.conv2", "mask_downscaling.3"),
    (r"mask_embed\.layer_norm2", "mask_downscaling.4"),
    (r"mask_embed\.conv3", "mask_downscaling.6"),
    (r"upscale_conv1", "output_upscaling.0"),
    (r"upscale_layer_norm", "output_upscaling.1"),
    (r"upscale_conv2", "output_upscaling.3"),
    (r"((?:head|mlps\.\d)\.)layers\.0", r"\1layers.1"),
    (r"((?:head|mlps\.\d)\.)proj_in", r"\1layers.0"),
    (r"((?:head|mlps\.\d)\.)proj_out", r"\1layers.2"),
    (r"layer_norm", "norm"),
]
PUBLISHED = """
image_encoder.pos_embed image_encoder.patch_embed.proj.weight image_encoder.blocks.0.norm1.weight
image_encoder.blocks.1.norm2.bias image_encoder.blocks.0.attn.rel_pos_h
image_encoder.blocks.0.attn.qkv.weight image_encoder.blocks.0.attn.proj.bias
image_encoder.blocks.1.mlp.lin2.weight image_encoder.neck.0.weight image_encoder.neck.1.bias
image_encoder.neck.2.weight image_encoder.neck.3.weight
prompt_encoder.pe_layer.positional_encoding_gaussian_matrix
prompt_encoder.point_embeddings.3.weight prompt_encoder.not_a_point_embed.weight
prompt_encoder.no_mask_embed.weight prompt_encoder.mask_downscaling.0.weight
prompt_encoder.mask_downscaling.1.weight prompt_encoder.mask_downscaling.3.bias
prompt_encoder.mask_downscaling.4.bias prompt_encoder.mask_downscaling.6.weight
mask_decoder.iou_token.weight mask_decoder.mask_tokens.weight
mask_decoder.transformer.layers.0.self_attn.q_proj.weight
mask_decoder.transformer.layers.1.cross_attn_token_to_image.out_proj.bias
mask_decoder.transformer.layers.0.norm4.weight mask_decoder.transformer.layers.0.mlp.lin1.weight
mask_decoder.transformer.final_attn_token_to_image.v_proj.weight
mask_decoder.transformer.norm_final_attn.weight mask_decoder.output_upscaling.0.weight
mask_decoder.output_upscaling.1.weight mask_decoder.output_upscaling.3.bias
mask_decoder.output_hypernetworks_mlps.3.layers.0.weight
mask_decoder.output_hypernetworks_mlps.0.layers.1.weight
mask_decoder.output_hypernetworks_mlps.0.layers.2.bias
mask_decoder.iou_prediction_head.layers.0.weight mask_decoder.iou_prediction_head.layers.1.bias
mask_decoder.iou_prediction_head.layers.2.bias
"""
SIZES = {  # width, layers, heads and layers that see the whole picture
    "base": (768, 12, 12, [2, 5, 8, 11]),
    "large": (1024, 24, 16, [5, 11, 17, 23]),
    "huge": (1280, 32, 16, [7, 15, 23, 31]),
}


def tiny_model():
    """The true architecture, small, with weights that react to picture and point."""
    config = transformers.SamConfig(
        vision_config=transformers.SamVisionConfig(
            hidden_size=32,
            output_channels=32,
            num_hidden_layers=2,
            num_attention_heads=2,
            image_size=SIDE,
            patch_size=8,
            window_size=3,
            global_attn_indexes=[1],
            num_pos_feats=16,
            mlp_dim=48,
        ),
        prompt_encoder_config=transformers.SamPromptEncoderConfig(
            hidden_size=32, image_size=SIDE, patch_size=8, mask_input_channels=8
        ),
        mask_decoder_config=transformers.SamMaskDecoderConfig(
            hidden_size=32, mlp_dim=64, iou_head_hidden_dim=40
        ),
    )
    torch.manual_seed(5)
    model = transformers.SamModel(config)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if weight.ndim > 1 and "positional_embedding" not in name:
                weight.normal_(0, (2 / weight[0].numel()) ** 0.5)
        model.mask_decoder.iou_prediction_head.proj_out.bias.fill_(0.9)
    return model.eval()


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A Hugging Face folder as `save_pretrained` writes it."""
    folder = tmp_path_factory.mktemp("sam")
    tiny_model().save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def checkpoint(weights, tmp_path_factory):
    """The same weights as an original checkpoint: a pickled dictionary with the old names."""
    path = tmp_path_factory.mktemp("original") / "sam_vit_tiny.pth"
    torch.save(original_weights(transformers.SamModel.from_pretrained(weights)), path)
    return path


def original_weights(model):
    original = {}
    for name, value in model.state_dict().items():
        if name.startswith("shared_image_embedding"):
            continue  # in the old files, the prompt encoder alone has it
        for pattern, old in ORIGINAL_NAMES:
            name = re.sub(pattern, old, name)
        original[name] = value
    return original


def variant(weights, **parameters):
    """All masks that the tiny network gives, whatever their expected IoU."""
    chosen = {"grid": 4, "iou": 0.0, "stability": 0.0, "cache": "none", "device": "cpu"}
    return SamBoundaries(str(weights), **(chosen | parameters))


def picture(shape=(48, 64), seed=0):
    noise = np.random.default_rng(seed).normal(size=shape).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3).reshape(shape)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def drawn(chosen, grey):
    return chosen(grey, np.ones(grey.shape, bool))[0]


def box_mask(top, left, bottom, right, shape=(32, 32)):
    mask = np.zeros(shape, bool)
    mask[top:bottom, left:right] = True
    return mask


def outline(top, left, bottom, right, shape=(32, 32)):
    inner = box_mask(top + 1, left + 1, bottom - 1, right - 1, shape)
    return box_mask(top, left, bottom, right, shape) & ~inner


# Known masks.


def test_boundaries_of_known_masks():
    masks = [box_mask(4, 5, 14, 20), box_mask(10, 10, 25, 30)]
    expected = outline(4, 5, 14, 20) | outline(10, 10, 25, 30)
    np.testing.assert_array_equal(boundary_map(masks, (32, 32)), expected)
    assert not boundary_map([], (32, 32)).any()


def fake(truth, ious, sharpness=50.0, shape=(32, 32)):
    """A network that answers every point with the same three masks, in a picture twice as wide."""
    low = torch.stack([torch.from_numpy(mask).float() for mask in truth])
    assert low.shape[1:] == shape

    def predict(points):
        assert points.dtype == np.float32 and points.shape[1:] == (2,)
        predict.asked.append(points)
        logits = ((low - 0.5) * sharpness).expand(len(points), -1, -1, -1)
        return logits, torch.tensor(ious).expand(len(points), -1)

    predict.asked = []
    return predict


THREE = [box_mask(4, 4, 12, 12), box_mask(16, 16, 28, 28), box_mask(2, 20, 10, 30)]


def test_points_form_an_even_grid_and_are_sent_in_batches():
    rules = SamBoundaries("somewhere", grid=4, prompts=7)
    predict = fake(THREE, [0.9, 0.9, 0.9])
    list(automatic_masks(predict, (32, 64), 128, rules))
    assert [len(points) for points in predict.asked] == [7, 7, 2]
    x, y = np.concatenate(predict.asked).T
    assert sorted(set(x)) == [16, 48, 80, 112] and sorted(set(y)) == [8, 24, 40, 56]


@pytest.mark.parametrize(
    "iou, sharpness, left",
    [(0.8, 50.0, 3), (0.92, 50.0, 2), (0.97, 50.0, 1), (1.0, 50.0, 0), (0.8, 2.1, 0)],
)
def test_masks_with_a_low_expected_iou_and_unstable_ones_are_dropped(iou, sharpness, left):
    """Where logits fall slowly across a border, the mask depends on where it is cut."""
    rules = SamBoundaries("somewhere", grid=1, iou=iou)
    predict = fake(THREE, [0.95, 0.99, 0.9], sharpness)
    assert len(list(automatic_masks(predict, (64, 64), 64, rules))) == left


def test_suppression_equals_that_of_opencv():
    rng = np.random.default_rng(1)
    first = rng.integers(0, 60, (200, 2))
    corners = np.hstack([first, first + rng.integers(5, 30, (200, 2))])
    scores = rng.permutation(200) / 200 + 0.01
    boxes = np.hstack([first, corners[:, 2:] - first]).tolist()
    expected = cv2.dnn.NMSBoxes(boxes, scores.tolist(), 0.0, 0.5)
    assert 10 < len(expected) < 180
    assert suppressed(corners, scores, 0.5) == list(expected)


@pytest.mark.slow
def test_pixels_equal_those_of_the_librarys_processor():
    from transformers.models.sam.image_processing_pil_sam import SamImageProcessorPil

    for shape in ((100, 256), (256, 200), (1500, 700)):
        grey = picture(shape)
        made = sam.network_pixels(grey, 1024).numpy()
        expected = SamImageProcessorPil()(
            np.repeat(grey[..., None], 3, axis=2), return_tensors="np"
        )["pixel_values"]
        assert made.shape == expected.shape == (1, 3, 1024, 1024)
        assert np.abs(made - expected).max() < 1.1 / 255 / 0.224  # a grey level of rounding


# The true architecture.


def test_gives_a_binary_map(weights):
    grey = picture()
    out = variant(weights)(grey, np.ones(grey.shape, bool))
    assert out.shape == (1, *grey.shape) and out.dtype == np.float32
    assert set(np.unique(out)) == {0.0, 1.0}
    assert not np.array_equal(out[0], drawn(variant(weights), picture(seed=1)))


def test_predictions_equal_those_of_the_library(weights):
    """The parts give the same for a point as the whole model."""
    model = transformers.SamModel.from_pretrained(weights)
    grey = picture()
    points = np.array([[10, 20], [40, 30]], np.float32)
    logits, iou = sam._predictor(model, grey, torch.float32)(points)
    with torch.no_grad():
        expected = model(
            pixel_values=sam.network_pixels(grey, SIDE),
            input_points=torch.from_numpy(points)[None, :, None],
        )
    torch.testing.assert_close(logits, expected.pred_masks[0])
    torch.testing.assert_close(iou, expected.iou_scores[0])
    assert logits.shape == (2, 3, 32, 32) and (logits[0] - logits[1]).abs().max() > 0.01


@pytest.mark.parametrize("precision", ["bf16", "fp16"])
def test_half_precision_is_close(weights, precision):
    rough = drawn(variant(weights, precision=precision), picture()) > 0
    exact = drawn(variant(weights), picture()) > 0
    assert (rough & exact).sum() > 0.9 * (rough | exact).sum() > 100


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (2, 3), (33, 47)])
def test_any_size_is_accepted(weights, shape):
    grey = picture(shape)
    out = variant(weights)(grey, np.ones(shape, bool))
    assert out.shape == (1, *shape) and set(np.unique(out)) <= {0.0, 1.0}


def test_invalid_pixels_are_zero_and_have_no_influence(weights):
    grey = picture()
    valid = np.ones(grey.shape, bool)
    valid[20:, 30:] = False
    painted = np.where(valid, grey, 255).astype(np.uint8)
    out, other = variant(weights)(grey, valid), variant(weights)(painted, valid)
    assert out.any() and not out[:, ~valid].any()
    assert not out[:, 18:20, 40:].any()  # along the border
    np.testing.assert_array_equal(out, other)


def test_a_picture_without_valid_pixels_does_not_run_the_network(tmp_path):
    out = variant(tmp_path / "none")(picture(), np.zeros((48, 64), bool))
    assert out.shape == (1, 48, 64) and not out.any()


def test_large_pictures_are_cut_into_windows(weights):
    grey = picture((32, 80))
    whole = drawn(variant(weights, window=32), grey)
    parts = [drawn(variant(weights, window=32), grey[:, x : x + 32]) for x in (0, 24, 48)]
    expected = np.zeros((32, 80), np.float32)
    for x, part in zip((0, 24, 48), parts, strict=True):
        expected[:, x : x + 32] = np.maximum(expected[:, x : x + 32], part)
    np.testing.assert_array_equal(whole, expected)
    assert not np.array_equal(whole, drawn(variant(weights, window=0), grey))


# The cache.


@pytest.fixture
def asked(monkeypatch):
    """Number of times a network was loaded."""
    calls = []
    real = sam._predictor
    monkeypatch.setattr(sam, "_predictor", lambda *given: calls.append(1) or real(*given))
    return calls


def test_second_call_does_not_run_the_network(weights, tmp_path, asked, monkeypatch):
    chosen = variant(weights, cache=str(tmp_path / "cache"))
    first = drawn(chosen, picture())
    assert len(asked) == 1 and first.any()
    monkeypatch.setattr(sam, "_model", lambda *given: pytest.fail("the network was loaded"))
    np.testing.assert_array_equal(drawn(chosen, picture()), first)
    assert len(asked) == 1


def test_the_cache_distinguishes_pictures_and_parameters(weights, tmp_path, asked):
    for grey in (picture(), picture(seed=1), picture().reshape(64, 48)):
        drawn(variant(weights, cache=str(tmp_path)), grey)
    for changed in ({"grid": 3}, {"overlap": 0.5}, {"precision": "bf16"}):
        drawn(variant(weights, cache=str(tmp_path), **changed), picture())
    assert len(asked) == 6
    drawn(variant(weights, cache=str(tmp_path), prompts=3), picture())  # only speed changes
    assert len(asked) == 6


def test_the_cache_distinguishes_weights_but_not_their_path(weights, tmp_path, asked):
    moved = tmp_path / "moved"
    shutil.copytree(weights, moved)
    for place in (weights, moved):
        drawn(variant(place, cache=str(tmp_path / "cache")), picture())
    assert len(asked) == 1
    model = transformers.SamModel.from_pretrained(moved)
    with torch.no_grad():
        model.mask_decoder.iou_token.weight += 1
    model.save_pretrained(moved)
    drawn(variant(moved, cache=str(tmp_path / "cache")), picture())
    assert len(asked) == 2


@pytest.mark.parametrize(
    "damage", [lambda b: b[:-5], lambda b: b"", lambda b: b[:40] + b"x" + b[41:]]
)
def test_damaged_entries_are_computed_again(weights, tmp_path, asked, damage, names_in):
    chosen = variant(weights, cache=str(tmp_path))
    first = drawn(chosen, picture())
    (entry,) = tmp_path.iterdir()
    whole = entry.read_bytes()
    entry.write_bytes(damage(whole))
    np.testing.assert_array_equal(drawn(chosen, picture()), first)
    assert len(asked) == 2 and entry.read_bytes() == whole
    assert names_in(tmp_path) == [entry.name]


def test_a_cache_that_cannot_be_written_does_not_fail_the_call(weights, tmp_path, caplog):
    blocked = tmp_path / "file"
    blocked.write_text("")
    out = drawn(variant(weights, cache=str(blocked / "below")), picture())
    np.testing.assert_array_equal(out, drawn(variant(weights), picture()))
    assert "could not write the cache entry" in caplog.text


def test_the_environment_sets_the_cache_folder(weights, tmp_path, monkeypatch, names_in):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    monkeypatch.delenv("ORTHONAV_CACHE", raising=False)
    drawn(variant(weights, cache=""), picture())
    assert len(list((tmp_path / "user" / "orthonav" / "sam").iterdir())) == 1
    monkeypatch.setenv("ORTHONAV_CACHE", str(tmp_path / "ours"))
    drawn(variant(weights, cache=""), picture())
    assert len(list((tmp_path / "ours" / "sam").iterdir())) == 1
    before = names_in(tmp_path)
    drawn(variant(weights, cache="none"), picture(seed=1))
    assert names_in(tmp_path) == before


# Weights.


def test_original_checkpoints_are_read(weights, checkpoint):
    names = set(torch.load(checkpoint, weights_only=True))
    assert set(PUBLISHED.split()) <= names and len(names) > 100
    parts = {"image_encoder", "prompt_encoder", "mask_decoder"}
    assert {name.partition(".")[0] for name in names} == parts
    model = sam.original_model(checkpoint)
    expected = transformers.SamModel.from_pretrained(weights)
    assert model.state_dict().keys() == expected.state_dict().keys()
    for name, value in expected.state_dict().items():
        torch.testing.assert_close(model.state_dict()[name], value, rtol=0, atol=0)
    grey = picture()
    out = drawn(variant(checkpoint), grey)
    assert out.any()
    np.testing.assert_array_equal(out, drawn(variant(weights), grey))


@pytest.mark.parametrize("size", sorted(SIZES))
def test_sizes_follow_from_the_shapes_of_the_weights(size):
    names = "hidden_size", "num_hidden_layers", "num_attention_heads", "global_attn_indexes"
    vision = transformers.SamVisionConfig(**dict(zip(names, SIZES[size], strict=True)))
    expected = transformers.SamConfig(vision_config=vision)
    with torch.device("meta"):
        original = original_weights(transformers.SamModel(expected))
    made = sam._config(original)
    for part in ("vision_config", "prompt_encoder_config", "mask_decoder_config"):
        found, wanted = getattr(made, part).to_dict(), getattr(expected, part).to_dict()
        assert found.pop("global_attn_indexes", []) == list(wanted.pop("global_attn_indexes", []))
        assert found == wanted


def test_incomplete_checkpoints_are_refused(checkpoint, tmp_path):
    whole = torch.load(checkpoint, weights_only=True)
    for name in ("mask_decoder.iou_token.weight", "image_encoder.neck.0.weight"):
        path = tmp_path / "part.pth"
        torch.save({key: value for key, value in whole.items() if key != name}, path)
        with pytest.raises(VariantError, match="not Segment Anything"):
            sam.original_model(path)
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(VariantError, match="not Segment Anything"):
        sam.original_model(tmp_path / "list.pth")


class Evil:
    """What a pickle could do."""

    def __reduce__(self):
        return (pytest.fail, ("code of a checkpoint was run",))


@pytest.mark.parametrize(
    "content", [b"", b"no checkpoint", pickle.dumps(Evil(), 2)], ids=["empty", "text", "code"]
)
def test_files_that_are_not_checkpoints_are_refused(tmp_path, content):
    path = tmp_path / "sam_vit_b.pth"
    path.write_bytes(content)
    with pytest.raises(VariantError, match="cannot read"):
        drawn(variant(path), picture())


def test_weights_of_another_model_are_refused(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "sam2"}))
    with pytest.raises(VariantError, match="'sam'"):
        drawn(variant(tmp_path), picture())


def test_missing_weights_name_their_source(tmp_path):
    with pytest.raises(MissingFileError, match=r"facebook/sam-vit-base.*fbaipublicfiles"):
        drawn(variant(tmp_path / "none"), picture())
    with pytest.raises(VariantError, match=r"weights=PATH.*facebook/sam-vit-base"):
        make_variant(TABLE, "sam")


@pytest.mark.parametrize(
    "text",
    [
        *("grid=0", "iou=1.1", "stability=-1", "offset=0", "overlap=2", "window=8"),
        *("per=view", "prompts=0", "device=tpu", "precision=fp8"),
    ],
)
def test_invalid_parameters_are_refused(text):
    with pytest.raises(VariantError, match=text.partition("=")[0]):
        make_variant(TABLE, f"sam:weights=somewhere,{text}")


def test_the_environment_may_name_the_weights(weights, monkeypatch):
    """A map does not store the path of the weights."""
    monkeypatch.setenv("ORTHONAV_SAM_WEIGHTS", str(weights))
    there = variant("")
    assert there.path == str(weights) and variant(weights).path == str(weights)
    np.testing.assert_array_equal(drawn(there, picture()), drawn(variant(weights), picture()))
    monkeypatch.delenv("ORTHONAV_SAM_WEIGHTS")
    with pytest.raises(VariantError, match="ORTHONAV_SAM_WEIGHTS"):
        variant("")


@pytest.mark.long
@pytest.mark.parametrize("per", [pytest.param("sheet", marks=pytest.mark.slow), "tile"])
def test_a_network_learns_from_the_boundaries_of_sheets_or_tiles(
    per, weights, area, tmp_path, monkeypatch
):
    """The whole path with a stand-in for the weights: imagery, network, map, views."""
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 4)
    monkeypatch.setenv(sam.WEIGHTS_VARIABLE, str(weights))
    given = "grid=4,iou=0,stability=0,cache=none,device=cpu,window=64"
    made_by = {
        "method": "autoencoder:width=8,dims=32,epochs=2,similarity=cosine",
        "edges": f"sam:per={per},{given}",
        "work": tmp_path / "work",
    }
    size = {"tile_px": 64, "gsd_m": 5.0, "overlap": 0.5, "registration": False}
    build_map(BuildRequest([area.past], tmp_path / "a.onav", **made_by, **size))
    opened = open_map(tmp_path / "a.onav")
    assert opened.manifest.recipe["represent"]["per"] == per
    localizer = Localizer(opened, registration=False, flying=False, position="best")
    grid, centres = localizer.grid, localizer.tiles.centres_en_m
    camera = Camera(64, 64, 64.0, 64.0, 32.0, 32.0)
    right = 0
    with Mosaic.open([area.past]).grid_sheet(localizer.sheet.frame, grid) as raster:
        for centre in centres[:: max(1, len(centres) // 6)]:
            col = round((centre[0] - grid.west_m) / 5.0 - 32)
            row = round((grid.north_m - centre[1]) / 5.0 - 32)
            grey = raster.read_grey(col, row, 64, 64).grey
            found = localizer.locate(View(grey, camera, Telemetry(0, 0.0, 0.0, 0.0, 320.0)))
            place = localizer.sheet.frame.en_from_latlon(found.lat_deg, found.lon_deg)
            right += np.hypot(*(place - centre)) < 1
    if per == "tile":  # tiles are segmented as views are
        assert right >= 5
