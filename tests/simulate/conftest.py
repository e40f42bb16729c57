"""What tests of simulated flights share: finding out where imagery is takes most of their time."""

import numpy as np
import pytest
from simulated import PLAIN, SMALL, frame_of

from helpers import textured
from orthonav.core.flight import open_flight, read_truth
from orthonav.ground.simulate import flight as flight_module
from orthonav.ground.simulate.flight import SimulateRequest, simulate_flight


@pytest.fixture(autouse=True)
def coarse_coverage(monkeypatch):
    monkeypatch.setattr("orthonav.ground.simulate.ground.COVERAGE_PX", 256)


@pytest.fixture(scope="module")
def ortho(make_ortho, tmp_path_factory):
    """1.2 x 1.2 km of blots."""
    return make_ortho(tmp_path_factory.mktemp("blots") / "blots.tif", textured((1200, 1200)))


@pytest.fixture(scope="module")
def frame(ortho):
    return frame_of(ortho)


@pytest.fixture
def fly(ortho, tmp_path, monkeypatch):
    """Function that flies at 100 m, `over` another orthophoto if given: the flight, its true places
    by frame, and, without `pictures`, which then are of one grey, what each would have been made
    of."""

    def flown(*, pictures=True, over=None, **request):
        asked = []

        def picture(*arguments):
            asked.append(arguments)
            return np.full((48, 64, 3), 99, np.uint8)

        folder = tmp_path / f"flight{len(list(tmp_path.glob('flight*')))}"
        request = {"agl_m": 100.0, "camera": SMALL, "effects": PLAIN, **request}
        with monkeypatch.context() as patch:
            if not pictures:
                patch.setattr(flight_module, "_picture", picture)
            simulate_flight(SimulateRequest([over or ortho], folder, **request))
        return open_flight(folder), read_truth(folder / "truth.csv"), asked

    return flown
