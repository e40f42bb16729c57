"""Position of one image: python examples/one_image.py area.onav 0100.jpg AGL_M [FOV_DEG].

The camera looks straight down, held by a gimbal, whose pitch and roll are good to 1 deg."""

import sys

import cv2

import orthonav

map_path, image_path, agl_m = sys.argv[1:4]
fov_deg = float(sys.argv[4]) if len(sys.argv) > 4 else 65.0
image = cv2.imread(image_path)
if image is None:
    sys.exit(f"image cannot be read: {image_path}")
camera = orthonav.Camera.from_fov(fov_deg, image.shape[1], image.shape[0])
localizer = orthonav.Localizer(orthonav.open_map(map_path))
fix = localizer.localize(
    image,
    camera,
    agl_m=float(agl_m),
    heading_deg=None,
    pitch_deg=0.0,
    roll_deg=0.0,
    tilt_std_deg=1.0,
)
if isinstance(fix, orthonav.Fix) and fix.is_confident:
    print(f"{fix.lat_deg:.6f}, {fix.lon_deg:.6f}, {fix.std_m:.1f} m, {fix.heading_deg:.1f} deg")
else:
    print(fix)
