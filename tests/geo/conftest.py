"""What tests of route files share."""

import json

import pytest

from orthonav.ground.planning.route import read_route


@pytest.fixture
def read(tmp_path):
    """Function that reads a route from a file of this content (bytes, text or JSON) and name, of
    which `#..` selects a line."""

    def read(content, name="a.geojson"):
        if not isinstance(content, bytes | str):
            content = json.dumps(content)
        data = content if isinstance(content, bytes) else content.encode()
        (tmp_path / name.partition("#")[0]).write_bytes(data)
        return read_route(tmp_path / name)

    return read
