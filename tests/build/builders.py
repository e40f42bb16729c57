"""Small maps."""

from orthonav.core.mapfile import open_map
from orthonav.ground.build import BuildRequest, build_map


def built(ortho, folder, name="map.onav", **request):
    """A map; by default without the registration layer, whose calibration takes longest."""
    request = {"tile_px": 64, "overlap": 0.75, "registration": False, **request}
    orthos = ortho if isinstance(ortho, list) else [ortho]
    build_map(BuildRequest(orthos, folder / name, **request))
    return open_map(folder / name)


WITH_LAYER = {"registration": True, "calibration_views": 2}
