"""The three compared transforms give the same scores."""

import numpy as np
import pytest

from benchmarks import fft


@pytest.mark.parametrize(("side", "view"), [(40, 11), (45, 20)])
def test_the_libraries_agree(side, view):
    scores = {name: pose() for name, pose in fft.poses(side, view).items() if name != "kernel"}
    assert set(scores) == {"scipy", "numpy", "OpenCV"}
    for made in scores.values():
        np.testing.assert_allclose(made, scores["scipy"], atol=1e-3 * np.abs(made).max())
