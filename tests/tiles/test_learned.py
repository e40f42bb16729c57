"""Edges by a network: its file is checked when it is opened, and a map flies with its own only."""

import json

import numpy as np
import onnx
import pytest
from pictures import edge_network, everywhere, sharp

from orthonav.core.errors import MapFileError, MissingExtraError, MissingFileError, VariantError
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.tiles import learned
from orthonav.core.tiles.learned import VARIABLE, LearnedEdges
from orthonav.core.tiles.represent import TABLE
from orthonav.core.variants import make_variant, variant_from_recipe
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.build.encoders import stored_representation

DOUBLE = onnx.TensorProto.DOUBLE


@pytest.fixture
def network(tmp_path):
    return edge_network(tmp_path / "edges.onnx")


def test_edges_are_where_the_network_is_positive(network):
    grey = np.random.default_rng(0).integers(0, 256, (40, 50)).astype(np.uint8)
    made = make_variant(TABLE, f"onnx:weights={network}")
    assert made.margin_px == 2 and made.channels == 1
    padded = np.pad(grey.astype(np.float64) / 255, 2, mode="edge")
    means = sum(padded[y : y + 40, x : x + 50] for y in range(5) for x in range(5)) / 25
    np.testing.assert_array_equal(made(grey, everywhere(grey))[0], means - grey / 255 > 0.02)


def test_a_map_stores_the_digest_and_not_the_path(network, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)  # experiments set it
    stored = stored_representation(LearnedEdges(str(network)))
    assert stored["weights"] == "" and len(stored["sha256"]) == 64
    plain = json.loads(json.dumps(stored))
    with pytest.raises(VariantError, match=VARIABLE):
        variant_from_recipe(TABLE, plain, flying=True)
    monkeypatch.setenv(VARIABLE, str(network))
    assert variant_from_recipe(TABLE, plain, flying=True).margin_px == 2


def test_another_network_than_the_maps_is_refused(network, tmp_path, monkeypatch):
    plain = stored_representation(LearnedEdges(str(network)))
    other = edge_network(tmp_path / "other.onnx", kernel=sharp(threshold=0.03))
    monkeypatch.setenv(VARIABLE, str(other))
    with pytest.raises(VariantError, match="another edge network"):
        variant_from_recipe(TABLE, plain, flying=True)


def test_a_network_that_is_exchanged_in_flight_is_refused(network):
    made = LearnedEdges(str(network))
    edge_network(network, kernel=sharp(threshold=0.5))
    learned._network.cache_clear()
    with pytest.raises(VariantError, match="another edge network"):
        made(np.zeros((9, 9), np.uint8), np.ones((9, 9), bool))


@pytest.mark.parametrize(
    "fields, says",
    [
        ({"names": ("image", "edges")}, "no network from"),
        ({"names": ("grey", "out")}, "no network from"),
        ({"kind": DOUBLE}, "no network from"),
        ({"strides": (2, 2)}, "same margin"),
        ({"pads": (1, 0, 1, 0)}, "same margin"),
        ({"pads": (3, 3, 3, 3)}, "margin of 0 to 32 px, got -1"),
        ({"kernel": (sharp()[0].repeat(2, 0), sharp()[1].repeat(2))}, "same margin"),
        ({"kernel": sharp(69)}, "margin of 0 to 32 px, got 34"),
    ],
)
def test_a_network_of_another_shape_is_refused(tmp_path, fields, says):
    path = edge_network(tmp_path / "edges.onnx", **fields)
    with pytest.raises(VariantError, match=says):
        LearnedEdges(str(path))


def test_what_is_no_network_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "edges.onnx"
    with pytest.raises(MissingFileError, match="does not exist"):
        LearnedEdges(str(path))
    for data in (b"", b"no network", edge_network(path).read_bytes()[:-40]):
        path.write_bytes(data)
        with pytest.raises(VariantError, match="no network from"):
            LearnedEdges(str(path))
    monkeypatch.setattr(learned, "MAX_BYTES", 3)
    with pytest.raises(VariantError, match="larger than"):
        LearnedEdges(str(path))
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(VariantError, match="weights=PATH"):
        LearnedEdges()


def test_the_extra_is_named_where_onnxruntime_is_absent(network, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    learned._network.cache_clear()
    with pytest.raises(MissingExtraError, match=r"orthonav\[neural\]"):
        LearnedEdges(str(network))


def test_a_map_with_such_edges_flies_with_its_network_only(area, tmp_path, monkeypatch, network):
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 12)
    path = tmp_path / "area.onav"
    build_map(
        BuildRequest(
            [area.past],
            path,
            edges=f"onnx:weights={network}",
            registration=False,
            tile_px=64,
            gsd_m=5.0,
            overlap=0.75,
        )
    )
    assert str(network).encode() not in path.read_bytes()
    with pytest.raises(MapFileError, match="map cannot be flown"):
        Localizer(open_map(path), registration=False)
    monkeypatch.setenv(VARIABLE, str(network))
    assert Localizer(open_map(path), registration=False).tiles.representation.margin_px == 2
