"""SuperPoint: the true architecture with random weights, read by the real code."""

import json
import shutil

import cv2
import numpy as np
import pytest
import torch
import transformers
from safetensors.torch import load_file, save_file

from orthonav.core.errors import MissingFileError, VariantError
from orthonav.research.superpoint import SuperPoint

BORDER_PX = 4


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A folder as `save_pretrained` writes it, with weights that react to the picture."""
    config = transformers.SuperPointConfig(keypoint_threshold=0.016)
    torch.manual_seed(3)
    model = transformers.SuperPointForKeypointDetection(config)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if name.endswith("weight"):
                weight.normal_(0, (2 / weight[0].numel()) ** 0.5)
    folder = tmp_path_factory.mktemp("superpoint")
    model.save_pretrained(folder)
    return folder


def picture(shape=(96, 120), seed=0):
    noise = np.random.default_rng(seed).normal(size=shape).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5).reshape(shape)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def describe(weights, grey, **parameters):
    points, radii, descriptors = SuperPoint(str(weights), device="cpu", **parameters)(grey)
    assert radii.tolist() == [8.0] * len(points)
    return points, descriptors


def test_points_and_unit_descriptors(weights):
    points, descriptors = describe(weights, picture())
    assert points.dtype == descriptors.dtype == np.float32
    assert len(points) > 20 and descriptors.shape == (len(points), 256)
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, atol=1e-5)
    assert (points >= BORDER_PX + 0.5).all() and (points <= np.array([115.5, 91.5])).all()
    np.testing.assert_array_equal(points % 1, 0.5)  # centres of pixels
    assert len(np.unique(points, axis=0)) == len(points)


def test_it_equals_the_library(weights):
    """The same points and descriptors as the library's own processor and model give."""
    from transformers.models.superpoint.image_processing_pil_superpoint import (
        SuperPointImageProcessorPil,
    )

    grey = picture()
    model = transformers.SuperPointForKeypointDetection.from_pretrained(weights)
    processor = SuperPointImageProcessorPil(do_resize=False)
    pixels = processor(np.repeat(grey[..., None], 3, axis=2), return_tensors="pt")
    with torch.no_grad():
        found = model(**pixels)
    expected = {
        tuple((point * torch.tensor([120.0, 96.0])).round().int().tolist()): descriptor.numpy()
        for point, descriptor in zip(found.keypoints[0], found.descriptors[0], strict=True)
    }
    # The library clears its border at the left and the top only.
    expected = {
        p: d for p, d in expected.items() if p[0] < 120 - BORDER_PX and p[1] < 96 - BORDER_PX
    }
    points, descriptors = describe(weights, grey)
    assert len(points) == len(expected) > 20
    for (x, y), descriptor in zip(points, descriptors, strict=True):
        np.testing.assert_allclose(descriptor, expected[int(x), int(y)], atol=1e-5)


def test_strongest_points_first(weights):
    points, descriptors = describe(weights, picture())
    few, few_descriptors = describe(weights, picture(), max_points=7)
    np.testing.assert_array_equal(few, points[:7])
    np.testing.assert_array_equal(few_descriptors, descriptors[:7])


@pytest.mark.parametrize("shape", [(1, 1), (5, 40), (64, 64), (61, 83)])
def test_any_size_is_accepted(weights, shape):
    points, descriptors = describe(weights, picture(shape))
    assert descriptors.shape == (len(points), 256)
    assert (points < np.array(shape)[::-1] - BORDER_PX).all()


def test_no_keypoints_is_empty(weights, tmp_path):
    folder = tmp_path / "deaf"
    shutil.copytree(weights, folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"keypoint_threshold": 0.999}))
    points, descriptors = describe(folder, picture())
    assert points.shape == (0, 2) and descriptors.shape == (0, 256)


def test_missing_weights_name_their_source(tmp_path):
    with pytest.raises(MissingFileError, match="magic-leap-community/superpoint"):
        describe(tmp_path / "none", picture())
    with pytest.raises(VariantError, match="weights=PATH"):
        SuperPoint()


def test_other_incomplete_and_damaged_weights_are_refused(weights, tmp_path):
    folder = shutil.copytree(weights, tmp_path / "copy")
    tensors = load_file(folder / "model.safetensors")
    del tensors["descriptor_decoder.conv_descriptor_b.weight"]  # the library would make one up
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(VariantError, match="conv_descriptor_b"):
        describe(folder, picture())
    (folder / "model.safetensors").write_bytes(b"not safetensors")
    with pytest.raises(VariantError, match="cannot read"):
        describe(folder, picture())
    (folder / "config.json").write_text('{"model_type": "sam"}')
    with pytest.raises(VariantError, match="superpoint"):
        describe(folder, picture())
    (folder / "config.json").unlink()
    with pytest.raises(VariantError, match=r"config\.json"):
        describe(folder, picture())


@pytest.mark.parametrize("parameters", [{"max_points": -1}, {"device": "tpu"}])
def test_invalid_parameters_are_refused(parameters):
    with pytest.raises(VariantError, match=next(iter(parameters))):
        SuperPoint("somewhere", **parameters)
