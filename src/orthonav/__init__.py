"""Position fixes for aircraft without GNSS: a downward camera is compared with an orthophoto.

    import cv2, orthonav

    localizer = orthonav.Localizer(orthonav.open_map("area.onav"))
    camera = orthonav.Camera.from_fov(65, 1280, 960)
    fix = localizer.localize(cv2.imread("0100.jpg"), camera, agl_m=270, heading_deg=None)
    if isinstance(fix, orthonav.Fix) and fix.is_confident:
        print(fix.lat_deg, fix.lon_deg, fix.std_m, fix.heading_deg)

`build_map` makes a map from orthophotos, `Tracker` follows a flight, `evaluate` compares fixes with
ground truth. The names in `__all__` are stable from version 0.2 on; modules below are not.
"""

import lazy_loader

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
