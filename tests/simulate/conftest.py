"""What tests of simulated flights share: finding out where imagery is takes most of their time."""

import pytest


@pytest.fixture(autouse=True)
def coarse_coverage(monkeypatch):
    monkeypatch.setattr("orthonav.ground.simulate.ground.COVERAGE_PX", 256)
