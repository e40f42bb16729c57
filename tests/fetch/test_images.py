"""What is no picture of the asked size is refused, by name; what is empty is seen to be."""

import io
import zlib

import numpy as np
import pytest
import terrain
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from orthonav.ground.fetch.client import BadReplyError, HttpReply, bad_status
from orthonav.ground.fetch.images import decode, image_or_absent

RNG = np.random.default_rng(0)
NOISE = RNG.integers(1, 255, (256, 256, 3), dtype=np.uint8)
PNG = terrain.encoded(NOISE)
JPEG = terrain.encoded(NOISE, "JPEG", quality=95, subsampling=0)
SHAPE = (256, 256)
WMS_ERROR = b"""<?xml version="1.0"?><ServiceExceptionReport version="1.3.0"
xmlns="http://www.opengis.net/ogc"><ServiceException code="LayerNotDefined">
Layer ORTHO unknown</ServiceException></ServiceExceptionReport>"""
OWS_ERROR = b"""<ExceptionReport xmlns="http://www.opengis.net/ows/1.1"><Exception
exceptionCode="InvalidParameterValue" locator="style"><ExceptionText>Style normal unknown
</ExceptionText></Exception></ExceptionReport>"""
OUT_OF_RANGE = OWS_ERROR.replace(b"InvalidParameterValue", b"TileOutOfRange")


def reply(body, status=200, kind="image/png"):
    return HttpReply("http://a/b", status, {"content-type": kind}, body)


@pytest.mark.parametrize("body", [PNG, JPEG, terrain.encoded(NOISE, "WEBP", lossless=True)])
def test_pictures_are_taken_whatever_they_are_called(body):
    assert image_or_absent(reply(body, kind="text/plain"), SHAPE, None) == body
    picture = decode(body, SHAPE, None)
    assert picture.bands.shape == (3, *SHAPE) and picture.valid.all() and not picture.blank
    assert np.abs(picture.bands.transpose(1, 2, 0).astype(int) - NOISE).mean() < 30


@pytest.mark.parametrize(
    "body, status, words, again",
    [
        (b"<!DOCTYPE html><html><body>Log in", 200, "page or text .*Log in", True),
        (b"Quota exceeded", 200, "not an image", True),
        (b'{"error": "no"}', 200, "page or text", True),
        (WMS_ERROR, 200, "LayerNotDefined Layer ORTHO unknown", True),
        (OWS_ERROR, 400, "HTTP 400 .*Style normal unknown", False),
        (b"no", 401, "HTTP 401", False),
        (b"no", 403, "HTTP 403", False),
        (b"", 200, "not an image", True),
        (JPEG[:-100], 200, "cut short|broken", True),
        (JPEG[: len(JPEG) // 2], 200, "cut short|broken", True),
        (PNG[: len(PNG) // 2], 200, "broken", True),
        (PNG[:30], 200, "broken|not an image", True),
        (terrain.encoded(NOISE[:128]), 200, "256 x 128 px instead of 256 x 256", False),
        (terrain.encoded(np.zeros((1, 1, 3), np.uint8)), 200, "1 x 1 px instead", False),
        (terrain.encoded(NOISE, "GIF"), 200, "not an image", True),
        (terrain.encoded(NOISE, "TIFF"), 200, "not an image", True),
    ],
)
def test_other_answers_are_rejected(body, status, words, again):
    with pytest.raises(BadReplyError, match=words) as raised:
        image_or_absent(reply(body, status), SHAPE, None)
    assert raised.value.again == again and len(str(raised.value)) < 500


@pytest.mark.parametrize(
    "body, status",
    [(b"", 204), (b"not found", 404), (b"gone", 410), (OUT_OF_RANGE, 400), (OUT_OF_RANGE, 200)],
)
def test_reported_gaps_are_absent(body, status):
    assert image_or_absent(reply(body, status), SHAPE, None) is None


def test_a_service_of_maps_has_no_tiles_to_miss():
    with pytest.raises(BadReplyError, match="HTTP 404"):
        image_or_absent(reply(b"not found", 404), SHAPE, None, tiled=False)


def test_a_bomb_is_rejected_by_its_head():
    head = bytearray(terrain.encoded(np.zeros((16, 16, 3), np.uint8)))
    head[16:24] = (100_000).to_bytes(4, "big") * 2  # width and height of 100000 px
    head[29:33] = zlib.crc32(head[12:29]).to_bytes(4, "big")
    with pytest.raises(BadReplyError, match=r"100000 x 100000|broken"):
        image_or_absent(reply(bytes(head)), SHAPE, None)


@pytest.mark.parametrize("level, blank", [(0, True), (255, True), (1, False), (128, False)])
def test_pictures_of_nothing(level, blank):
    body = terrain.encoded(np.full((256, 256, 3), level, np.uint8))
    assert decode(body, SHAPE, None).blank == blank


def test_clear_pixels_are_not_valid():
    clear = np.dstack([NOISE, np.full(SHAPE, 255, np.uint8)])
    clear[:100, :, 3] = 0
    picture = decode(terrain.encoded(clear), SHAPE, None)
    assert not picture.valid[:100].any() and picture.valid[100:].all()
    clear[..., 3] = 0
    assert decode(terrain.encoded(clear), SHAPE, None).blank


def test_a_palette_with_a_clear_colour():
    image = Image.fromarray(np.repeat(np.arange(256, dtype=np.uint8)[:, None], 256, 1)).convert("P")
    picture = decode(_saved(image, transparency=0), SHAPE, None)
    assert not picture.valid[0].any() and picture.valid[1:].all()


def _saved(image, **options):
    stream = io.BytesIO()
    image.save(stream, "PNG", **options)
    return stream.getvalue()


def test_grey_becomes_three_bands_and_deep_pixels_are_refused():
    grey = decode(_saved(Image.fromarray(NOISE[..., 0])), SHAPE, None)
    assert (grey.bands == NOISE[..., 0]).all()
    with pytest.raises(BadReplyError, match="unknown kind"):
        decode(_saved(Image.fromarray(NOISE[..., 0].astype(np.uint16) * 257)), SHAPE, None)


@pytest.mark.parametrize("colour, level", [("black", 0), ("white", 255)])
def test_large_patches_of_a_colour_of_nothing(colour, level):
    scene = NOISE.copy()
    scene[:, :100] = level  # the edge of the coverage
    scene[200:210, 200:210] = level  # a roof, or a shadow
    picture = decode(terrain.encoded(scene), SHAPE, colour)
    assert not picture.valid[:, :100].any() and picture.valid[:, 100:].all()
    assert decode(terrain.encoded(scene), SHAPE, None).valid.all()


@given(st.binary(max_size=300), st.integers(0, 20), st.sampled_from([PNG, JPEG]))
def test_damaged_bytes_raise_nothing_else(noise, cut, whole):
    at = len(whole) * cut // 20
    for body in (noise, whole[:at] + noise, whole[:at] + noise + whole[at + len(noise) :]):
        try:
            found = image_or_absent(reply(body), SHAPE, "black")
        except BadReplyError:
            continue
        assert found in (None, body)


def test_an_error_never_holds_the_bytes_of_a_picture():
    text = str(bad_status(reply(JPEG, status=500, kind="image/jpeg")))
    assert text == f"HTTP 500 ({len(JPEG)} bytes that are not text)"
    assert "Dienst gestört" in str(bad_status(reply("Dienst gestört".encode(), status=500)))
