"""The shapes of a check as a GeoPackage that QGIS opens with colours of its own."""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from orthonav.check.write.shapes import Layer
from orthonav.check.write.styles import layer_styles
from orthonav.errors import OutputError
from orthonav.extras import missing_extra

_DATE = "2000-01-01T00:00:00.000Z"
"""Stands for the time of writing in the file, so that the same check gives the same bytes."""
_STYLES = """CREATE TABLE layer_styles (
  id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT(256),
  f_table_schema TEXT(256), f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30),
  styleQML TEXT, styleSLD TEXT, useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30),
  update_time DATETIME)"""
_STYLE_ROW = """INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name,
  f_geometry_column, styleName, styleQML, styleSLD, useAsDefault, description, owner, update_time)
  VALUES ('', '', ?, 'geom', ?, ?, '', 1, '', '', ?)"""
_CONTENTS_ROW = """INSERT INTO gpkg_contents (table_name, data_type, identifier, description,
  last_change) VALUES ('layer_styles', 'attributes', 'layer_styles', '', ?)"""


def write_geopackage(path: Path, layers: Sequence[Layer]) -> None:
    """Write `layers` in longitude and latitude (EPSG:4326) into a new file at `path`.

    Raises `MissingExtraError` without pyogrio, `OutputError` where it cannot be written whole.
    """
    try:
        from pyogrio.errors import DataLayerError, DataSourceError, FeatureError
    except ImportError as error:
        raise missing_extra("writing a check", "geo", "pyogrio", error) from error
    try:
        with _fixed_date():
            for i, layer in enumerate(layers):
                _write_layer(path, layer, append=i > 0)
        with closing(sqlite3.connect(path)) as database, database:
            _check_whole(database, layers)
            _add_styles(database, [layer.name for layer in layers])
    except (DataSourceError, DataLayerError, FeatureError, sqlite3.Error) as error:
        raise OutputError(f"cannot write ({error}): {path.name}") from error


def _write_layer(path: Path, layer: Layer, append: bool) -> None:
    import shapely
    from pyogrio import raw

    wkb: Any = shapely.to_wkb(np.array(list(layer.shapes), dtype=object))
    raw.write(
        path,
        geometry=np.asarray(wkb, dtype=object),
        fields=np.array(list(layer.columns)),
        field_data=list(layer.columns.values()),
        layer=layer.name,
        driver="GPKG",
        geometry_type=layer.kind,
        crs="EPSG:4326",
        append=append,
        layer_options={"GEOMETRY_NAME": "geom", "FID": "fid"},
    )


@contextmanager
def _fixed_date() -> Iterator[None]:
    from pyogrio import get_gdal_config_option, set_gdal_config_options

    before = get_gdal_config_option("OGR_CURRENT_DATE")
    set_gdal_config_options({"OGR_CURRENT_DATE": _DATE})
    try:
        yield
    finally:
        set_gdal_config_options({"OGR_CURRENT_DATE": before})


def _check_whole(database: sqlite3.Connection, layers: Sequence[Layer]) -> None:
    """GDAL writes its last pages while closing, and fails there silently."""
    for layer in layers:
        (count,) = database.execute(f'SELECT count(*) FROM "{layer.name}"').fetchone()
        if count != len(layer.shapes):
            raise sqlite3.DatabaseError(f"{count} of {len(layer.shapes)} {layer.name} were written")


def _add_styles(database: sqlite3.Connection, names: Sequence[str]) -> None:
    database.execute(_STYLES)
    database.execute(_CONTENTS_ROW, (_DATE,))
    for name, qml in layer_styles().items():
        if name in names:
            database.execute(_STYLE_ROW, (name, name, qml, _DATE))
