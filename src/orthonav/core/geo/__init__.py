"""Geometry without GDAL or PROJ: local frames, tile grids, areas, the camera, routes."""
