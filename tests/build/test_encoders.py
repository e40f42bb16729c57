"""Maps of the paper's methods: built, carried, flown like any other."""

import numpy as np
import pytest

from orthonav.core.errors import MapFileError, MissingExtraError, VariantError
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix
from orthonav.core.tiles.network import NetworkEmbedder
from orthonav.core.tiles.words import WordsEmbedder
from orthonav.ground.build import BuildRequest, build_map, encoders
from orthonav.ground.build.encoders import usual_edges
from orthonav.ground.recordings.localize import localize_flight
from orthonav.onboard.run import SingleViews

SMALL = {"tile_px": 64, "gsd_m": 5.0, "overlap": 0.75, "calibration_views": 2}
METHODS = {
    "autoencoder:width=16,dims=64,epochs=1": NetworkEmbedder,
    "caevl:width=16,dims=64,epochs=1,tuning_epochs=1,batch=16,projector=32": NetworkEmbedder,
    "triplet:width=4,epochs=1,batch=64": NetworkEmbedder,
    "bovw:words=256": WordsEmbedder,
}
TRAINED = ("autoencoder", "caevl", "triplet")
"""Networks: a map of one is flown in the tests of networks in every run."""


@pytest.fixture(scope="module")
def built(area, tmp_path_factory):
    """A map of each method, built once."""
    made = {}

    def build(method, **more):
        key = method, str(sorted(more.items()))
        if key not in made:
            path = tmp_path_factory.mktemp("methods") / "area.onav"
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("orthonav.ground.build.calibrate.CROPS", 24)
                request = BuildRequest([area.past], path, method=method, **{**SMALL, **more})
                made[key] = build_map(request)
            made[key] = path
        return made[key]

    return build


@pytest.mark.long
@pytest.mark.parametrize(
    "method",
    [
        pytest.param(each, marks=pytest.mark.slow if each.startswith(TRAINED) else ())
        for each in METHODS
    ],
)
def test_a_map_of_any_method_flies(built, flight_path, method):
    path = built(method)
    localizer = Localizer(open_map(path), registration=False)
    assert isinstance(localizer.tiles.embedder, METHODS[method])
    recipe = open_map(path).manifest.recipe
    assert recipe["method"] == method.partition(":")[0]
    assert recipe["represent"]["name"] == usual_edges(method)
    flight = open_flight(flight_path)
    for result in localize_flight(SingleViews(localizer), flight, views=flight.views[:3]):
        assert isinstance(result.outcome, Fix), result.outcome
        assert np.isfinite(result.outcome.evidence["lowe_ratio"])


def test_registration_works_on_maps_of_other_methods(built, flight_path):
    localizer = Localizer(open_map(built("bovw:words=256")))
    assert localizer.registration is not None and localizer.registration.propose is None
    flight = open_flight(flight_path)
    truth = read_truth(flight_path / "truth.csv")
    errors = []
    for result in localize_flight(SingleViews(localizer), flight, views=flight.views[:5]):
        frame = localizer.sheet.frame
        place = frame.en_from_latlon(result.outcome.lat_deg, result.outcome.lon_deg)
        errors.append(np.hypot(*(place - frame.en_from_latlon(*truth[result.frame]))))
    assert np.median(errors) < 15


@pytest.mark.parametrize(
    "method, edges, says",
    [
        ("autoencoder", "gradient", "one channel"),
        ("bovw", "canny", "grey levels"),
        ("triplet:width=0", None, "width must be"),
        ("vlad", None, "unknown variant 'vlad'"),
        ("autoencoder", "sam", "weights"),
    ],
)
def test_what_does_not_go_together_is_refused(area, tmp_path, method, edges, says):
    request = BuildRequest([area.past], tmp_path / "a.onav", method=method, edges=edges, **SMALL)
    with pytest.raises(VariantError, match=says):
        build_map(request)
    assert list(tmp_path.iterdir()) == []


def test_words_of_files_elsewhere_do_not_fly():
    from orthonav.core.tiles.embed import embedder_of

    plain = {"name": "bovw", "features": "superpoint", "weights": "/etc", "words": 256}
    with pytest.raises(MapFileError, match="do not fly"):
        embedder_of(plain, lambda *_: np.zeros(0), 1)


@pytest.mark.parametrize("method, hidden", [("autoencoder", "onnx"), ("bovw", "faiss")])
def test_what_is_missing_is_named_before_imagery_is_read(
    area, tmp_path, monkeypatch, method, hidden
):
    found = encoders.find_spec
    monkeypatch.setattr(encoders, "find_spec", lambda name: None if name == hidden else found(name))
    monkeypatch.setattr("orthonav.ground.build.build.Mosaic.open", lambda *_: pytest.fail("read"))
    with pytest.raises(MissingExtraError, match=rf"{hidden}: pip install 'orthonav\[train\]'"):
        build_map(BuildRequest([area.past], tmp_path / "a.onav", method=method, **SMALL))
