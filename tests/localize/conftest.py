"""The map of the known ground of `blots.py`, opened."""

import pytest
from blots import known_map

from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map


@pytest.fixture(scope="session")
def known(made_once, make_ortho):
    return known_map(made_once, make_ortho)


@pytest.fixture(scope="session")
def opened(known):
    return open_map(known.path)


@pytest.fixture(scope="module")
def known_localizer(opened):
    return Localizer(opened)
