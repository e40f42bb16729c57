"""Cameras, places and routes of simulated flights."""

from helpers import waypoints
from orthonav.core.geo.camera import Camera
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Route
from orthonav.ground.simulate.render import ViewEffects

PLAIN = ViewEffects(exposure_std=0.0, blur_px=0.0, noise_std=0.0, jpeg_quality=100)
SMALL = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
SEEN = Camera(320, 240, 260.0, 255.0, 158.0, 121.5)
LENS = Camera(320, 240, 260.0, 255.0, 158.0, 121.5, (-0.15, 0.03, 0.001, -0.002))
WIDE = Camera(320, 240, 225.0, 225.0, 160.0, 120.0, (-0.28, 0.09, 0.001, -0.001, -0.012))
FISH = Camera(320, 240, 260.0, 255.0, 158.0, 121.5, (0.02, -0.01, 0.003, -0.001), "fisheye")


def frame_of(ortho):
    outline = Mosaic.open([ortho]).outline_latlon_deg
    return Area.from_outline(outline[:, 0], outline[:, 1]).frame


def route_of(frame, *points_en_m):
    return Route(waypoints(frame, points_en_m))


def write_route(path, route):
    rows = [f"{lat!r},{lon!r}" for lat, lon in route.waypoints]
    path.write_text("\n".join(["lat_deg,lon_deg", *rows]))
    return path
