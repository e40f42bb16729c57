"""What every representation promises, and what each says of itself."""

import cv2
import numpy as np
import pytest
from pictures import edge_network, everywhere, frozen, picture

from orthonav.core.errors import VariantError
from orthonav.core.tiles import embed
from orthonav.core.tiles.represent import TABLE, Canny, Gray, OrientedGradients
from orthonav.core.variants import make_variant
from orthonav.research.segments import Segments

SHAPES = [(1, 1), (1, 40), (2, 3), (16, 16), (33, 47), (64, 64), (256, 255)]


@pytest.fixture(params=sorted(name for name, each in TABLE.items() if each.flies))
def variant(request, monkeypatch, tmp_path):
    """Every entry of the table, with its defaults; edges by a network with a small one."""
    if request.param == "onnx":
        monkeypatch.setenv("ORTHONAV_EDGES", str(edge_network(tmp_path / "edges.onnx")))
    return make_variant(TABLE, request.param)


@pytest.mark.parametrize("shape", SHAPES)
def test_shape_dtype_and_finite(variant, shape):
    grey = picture(shape)
    out = variant(grey, everywhere(grey))
    assert out.shape == (variant.channels, *shape) and out.dtype == np.float32
    assert np.isfinite(out).all()


def test_an_image_gives_a_nonzero_result(variant):
    grey = picture()
    out = variant(grey, everywhere(grey))
    assert (out.reshape(len(out), -1).std(axis=1) > 0).all()


def test_deterministic_and_inputs_untouched(variant):
    grey = picture()
    valid = everywhere(grey)
    first, second = variant(grey, valid), variant(grey.copy(), valid.copy())
    assert first.tobytes() == second.tobytes()
    assert not np.shares_memory(first, grey)
    np.testing.assert_array_equal(grey, picture())


@pytest.mark.parametrize("level", [0, 1, 128, 255])
@pytest.mark.parametrize("shape", [(16, 16), (40, 41)])
def test_blank_is_flat(variant, level, shape):
    grey = np.full(shape, level, np.uint8)
    out = variant(grey, everywhere(grey))
    assert np.isfinite(out).all()
    assert np.ptp(out.reshape(len(out), -1), axis=1).max() < 1e-2


@pytest.mark.parametrize("shape", SHAPES)
def test_nothing_valid_is_zero(variant, shape):
    grey = picture(shape)
    assert not variant(grey, np.zeros(shape, dtype=bool)).any()


def test_masked_pixels_are_zero_and_have_no_influence(variant):
    grey = picture((128, 128))
    valid = everywhere(grey).copy()
    valid[40:90, 50:] = False
    valid[3, 3] = False
    painted = np.where(valid, grey, 255).astype(np.uint8)
    out, other = variant(grey, frozen(valid)), variant(painted, valid)
    assert not out[:, ~valid].any()
    far = cv2.erode(valid.astype(np.uint8), np.ones((31, 31), np.uint8)) > 0
    if not isinstance(variant, Canny | Segments):  # hysteresis follows an edge however far
        np.testing.assert_array_equal(out[:, far], other[:, far])
        unmasked = variant(grey, everywhere(grey))
        np.testing.assert_array_equal(out[:, far], unmasked[:, far])


def test_the_border_of_the_valid_area_is_no_edge():
    valid = np.zeros((64, 64), dtype=bool)
    valid[20:, 20:] = True
    grey = np.where(valid, 200, 0).astype(np.uint8)
    for name in ("canny", "canny:kernel=7", "gradient", "gradient:sigma_px=4"):
        assert np.abs(make_variant(TABLE, name)(grey, valid)).max() < 1e-2, name


def test_gray_is_the_grey_level():
    grey = picture()
    np.testing.assert_array_equal(Gray()(grey, everywhere(grey))[0] * 255, grey)


@pytest.mark.parametrize("low, high, kernel", [(100, 200, 3), (50, 80, 3), (2000, 4000, 5)])
def test_canny_is_opencvs(low, high, kernel):
    grey = picture(blur=1.0)
    expected = cv2.Canny(grey, low, high, apertureSize=kernel, L2gradient=False) > 0
    assert expected.any() and not expected.all()
    np.testing.assert_array_equal(Canny(low, high, kernel)(grey, everywhere(grey))[0], expected)


def gradients(grey):
    return OrientedGradients()(grey, everywhere(grey))


def test_gradients_do_not_see_the_sign_of_contrast():
    grey = picture()
    np.testing.assert_allclose(gradients(255 - grey), gradients(grey), atol=1e-3)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_gradients_turn_with_the_picture(quarters):
    """A quarter turn adds 90 degrees to a direction t: exp(2ik t) changes sign for odd k only."""
    sign = np.array([1, -1, -1, 1, 1, -1, -1.0]) ** quarters
    grey = picture((64, 80))
    turned = gradients(np.ascontiguousarray(np.rot90(grey, quarters)))
    expected = np.rot90(gradients(grey), quarters, axes=(1, 2)) * sign[:, None, None]
    np.testing.assert_allclose(turned, expected, atol=1e-3)


@pytest.mark.parametrize("direction_deg", range(0, 180, 15))
def test_harmonics_of_a_known_edge(direction_deg):
    """On a ramp the direction of the gradient is the ramp's, everywhere."""
    turn = np.radians(direction_deg)
    y, x = np.mgrid[:96, :96] - 48.0
    ramp = np.rint(128 + 1.8 * (x * np.cos(turn) + y * np.sin(turn))).clip(0, 255)
    out = OrientedGradients(4.0)(ramp.astype(np.uint8), np.ones((96, 96), bool))[:, 40:56, 40:56]
    magnitude, *harmonics = out.mean(axis=(1, 2))
    assert magnitude == pytest.approx(1.8, rel=0.02)
    for k in (1, 2, 3):
        measured = complex(harmonics[2 * k - 2], harmonics[2 * k - 1])
        off = np.angle(measured * np.exp(-2j * k * turn))
        assert abs(np.degrees(off)) < 2 and abs(measured) > 0


IMPOSSIBLE = {
    "canny": ("low=200,high=100", "low=-1", "kernel=4", "kernel=9"),
    "gradient": ("sigma_px=0", "sigma_px=-1", "sigma_px=17"),
    "segments": ("scale=0", "scale=-1", "sigma=-0.1", "sigma=17", "min_size=0"),
}
IMPOSSIBLE_EMBEDDINGS = {
    "gradient": ("cells=0", "cells=5", "cells=64", "dims=0", "dims=5000", "floor=0", "floor=-1"),
    "bovw": (
        *("words=255", "words=10001", "features=orb", "features=superpoint", "weights=somewhere"),
        *("max_features=0", "similarity=l2", "tfidf=2"),
    ),
    "autoencoder": (
        *("dims=0", "width=12", "epochs=0", "batch=0", "learning_rate=0.0", "similarity=best"),
        "precision=int4",
    ),
}
REFUSED = [
    (table, f"{name}:{text}")
    for table, texts in ((TABLE, IMPOSSIBLE), (embed.TABLE, IMPOSSIBLE_EMBEDDINGS))
    for name, each in texts.items()
    for text in each
]


@pytest.mark.parametrize("table, text", REFUSED, ids=[text for _, text in REFUSED])
def test_impossible_parameters_are_refused(table, text):
    with pytest.raises(VariantError, match=text.partition(":")[2].partition("=")[0]):
        make_variant(table, text)
