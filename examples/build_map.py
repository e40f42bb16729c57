"""A map of an orthophoto: python examples/build_map.py orthophoto.tif area.onav [GSD_M].

Without GSD_M its resolution suits the orthophoto."""

import sys

import orthonav

ortho, out = sys.argv[1:3]
gsd_m = float(sys.argv[3]) if len(sys.argv) > 3 else None
orthonav.build_map(orthonav.BuildRequest([ortho], out, gsd_m=gsd_m))
print(orthonav.open_map(out))
