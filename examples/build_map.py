"""A map of an orthophoto: python examples/build_map.py orthophoto.tif area.onav GSD_M."""

import sys

import orthonav

ortho, out, gsd_m = sys.argv[1:]
orthonav.build_map(orthonav.BuildRequest([ortho], out, gsd_m=float(gsd_m)))
print(orthonav.open_map(out))
