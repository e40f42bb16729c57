"""One or several orthophotos as one image."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray

from orthonav.core.errors import ImageryError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.ground.imagery.folder import sources_in
from orthonav.ground.imagery.lattice import Lattice, lattices_of
from orthonav.ground.imagery.plates import at_epoch
from orthonav.ground.imagery.raster import GDAL_OPTIONS, GreyPixels, Pixels, SheetRaster
from orthonav.ground.imagery.source import Source, open_sources
from orthonav.ground.imagery.stretch import ContrastStretch, sample_stretches

__all__ = ["GreyPixels", "Mosaic", "Pixels", "SheetRaster"]


@dataclass(frozen=True, eq=False)
class Mosaic:
    """Orthophotos read as one; where several overlap, the first one given wins.

    `stretches` maps the values of each source to 8 bits, None where they have 8 bits.
    """

    sources: tuple[Source, ...]
    stretches: tuple[ContrastStretch | None, ...]

    @classmethod
    def open(cls, paths: Sequence[Path], epoch: float | None = None) -> "Mosaic":
        """Inspect files, and all orthophotos of folders, the newest first; nothing stays open.

        `epoch`: decimal year at which positions in systems of plates are those of WGS 84; None:
        they are taken as they are. Raises as `open_source`, `sources_in` and `at_epoch` do.
        """
        if not paths:
            raise ImageryError("no orthophoto was given")
        sources: list[Source] = []
        files: list[Path] = []
        for path in map(Path, paths):
            if path.is_dir():
                sources += open_sources(files)[0] + sources_in(path)
                files = []
            else:
                files.append(path)
        sources += open_sources(files)[0]
        if epoch is not None:
            sources = at_epoch(sources, epoch)
        with rasterio.Env(**GDAL_OPTIONS):
            return cls(tuple(sources), sample_stretches(sources))

    @property
    def stretch(self) -> ContrastStretch | None:
        """The contrast stretch of the first source with more than 8 bits, if any."""
        return next((each for each in self.stretches if each is not None), None)

    @property
    def gsd_m(self) -> float:
        """Finest ground resolution of the sources in metres."""
        return min(source.gsd_m for source in self.sources)

    @property
    def outline_latlon_deg(self) -> NDArray[np.float64]:
        """Border points (N, 2) of all sources, latitude and longitude in degrees."""
        return np.concatenate([source.outline_latlon_deg for source in self.sources])

    @property
    def common_stamp(self) -> list[list[float] | None]:
        """The stretches, which all pixels depend on besides their files."""
        found = {(each.low, each.high) for each in self.stretches if each is not None}
        return [list(each) for each in sorted(found)]

    def describe(self) -> tuple[dict[str, Any], ...]:
        """Entries of the map's manifest: one per file, and one per kind of files of a folder."""
        kinds: dict[Any, list[Source]] = {}
        for index, source in enumerate(self.sources):
            alike: Any = index
            if source.folder is not None:
                alike = source.folder, source.crs, round(source.gsd_m, 3), source.dtype
            kinds.setdefault(alike, []).append(source)
        return tuple(_described(members) for members in kinds.values())

    def sheet(
        self,
        frame: LocalFrame,
        *,
        west_m: float,
        north_m: float,
        width_px: int,
        height_px: int,
        gsd_m: float,
        threads: int | None = None,
    ) -> SheetRaster:
        """The mosaic resampled into `frame`, as a raster that is read by windows (use `with`).

        It belongs to the thread that enters it, and uses `threads` of its own (None: all cores).
        """
        return SheetRaster(
            self.sources,
            self._lattices,
            self.stretches,
            frame,
            west_m=west_m,
            north_m=north_m,
            width_px=width_px,
            height_px=height_px,
            gsd_m=gsd_m,
            threads=threads,
        )

    def grid_sheet(
        self, frame: LocalFrame, grid: TileGrid, threads: int | None = None
    ) -> SheetRaster:
        """The raster that all tiles of a grid together cover (use `with`)."""
        return self.sheet(
            frame,
            west_m=grid.west_m,
            north_m=grid.north_m,
            width_px=grid.width_px,
            height_px=grid.height_px,
            gsd_m=grid.gsd_m,
            threads=threads,
        )

    @cached_property
    def _lattices(self) -> list[Lattice]:
        return lattices_of(self.sources)


def _described(sources: Sequence[Source]) -> dict[str, Any]:
    """A file, or the files of one kind of a folder: their number, first and last date."""
    first = sources[0]
    if first.folder is None:
        return first.describe()
    dates = sorted(source.date for source in sources if source.date is not None)
    entry = first.describe() | {
        "name": first.folder.resolve().name,
        "date": dates[-1] if dates else None,
        "files": len(sources),
    }
    del entry["width_px"], entry["height_px"]
    if dates and dates[0] != dates[-1]:
        entry["date_from"] = dates[0]
    return entry
