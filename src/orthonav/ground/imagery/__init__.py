"""Orthophotos: any georeferenced raster GDAL reads, resampled into a sheet window by window.

The only place that touches rasterio, apart from the writers in `orthonav.ground.simulate`.
"""
