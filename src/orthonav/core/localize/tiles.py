"""Placing a view by its tile: embed it under a few headings, and find the most similar tile.

As Di Piazza et al. 2024 do. Positions are good to a fraction of a tile; maps with a registration
layer are placed by `registration` instead, which uses these tiles for candidates only.
"""

import math
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError, VariantError
from orthonav.core.localize.checks import check_rectified
from orthonav.core.localize.logistic import LogisticConfidence
from orthonav.core.localize.match import Match, TileMatcher
from orthonav.core.localize.propose import TileProposer
from orthonav.core.localize.rectify import RectifiedView, downsampled, rectify
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.records import PRIOR_SIGMAS, TILE_YAW_STD_DEG, Fix, NoFix, Prior, Telemetry, View
from orthonav.core.tiles import represent
from orthonav.core.tiles.embed import embedder_of
from orthonav.core.tiles.exact import rows_within
from orthonav.core.tiles.position import PositionRule
from orthonav.core.variants import variant_from_recipe

HEADING_SIGMAS = 1.5
"""Headings are tried this far around the reported one, in its standard deviations: three headings
6 deg apart at 5 deg, as docs/decisions/embedding.md measured."""
UNKNOWN_HEADING_STEP_DEG = 8.0
"""Spacing of all headings where none is reported: embeddings find their tile up to 8 deg off
(docs/decisions/evidence.md)."""


class TileLocalizer:
    """Places views on the tiles of one map. Safe to share between threads."""

    def __init__(self, opened: MapFile, *, position: PositionRule, flying: bool) -> None:
        """See `Localizer`; raises `MapFileError` if this program cannot fly the map."""
        manifest = opened.manifest
        self.sheet = manifest.sheets[0]
        self.grid = self.sheet.grid
        self.centres_en_m = opened.array("sheet0/centres_en_m", np.float32, 2)
        embeddings = opened.array("sheet0/embeddings", np.float16, 2)
        try:
            self.representation = variant_from_recipe(
                represent.TABLE, manifest.recipe.get("represent"), flying=flying
            )
            self.embedder = embedder_of(
                manifest.recipe.get("embed"),
                lambda name, dtype, ndim: opened.array(f"embed/{name}", dtype, ndim),
                self.representation.channels,
            )
            plain = manifest.confidence
            self.confidence = None if plain is None else LogisticConfidence.from_plain(plain)
            self._step_deg = float(manifest.view["heading_step_deg"])
            self._position_std_m = float(manifest.view["position_std_m"])
            self._min_valid_share = float(manifest.view["min_valid_share"])
        except (VariantError, KeyError, TypeError, ValueError) as error:
            raise MapFileError(f"map cannot be flown ({error}): {opened.path}") from error
        tiles = self.sheet.tiles
        if self.centres_en_m.shape != (tiles, 2) or embeddings.shape != (tiles, self.embedder.dims):
            raise MapFileError(f"map's parts do not fit together: {opened.path}")
        if not (self._step_deg > 0 and self._position_std_m > 0 and manifest.radius_m > 0):
            raise MapFileError(f"map has impossible view parameters: {opened.path}")
        try:
            self.matcher = TileMatcher(self.grid, self.centres_en_m, embeddings, position)
        except MapFileError as error:
            raise MapFileError(f"{error}: {opened.path}") from error
        self.radius_m = manifest.radius_m

    def proposer(self) -> TileProposer | None:
        """What finds candidates for registration; None for embeddings that cannot."""
        return TileProposer.of(self.matcher, self.embedder, self.representation)

    def locate(self, view: View, prior: Prior | None, heading_known: bool) -> Fix | NoFix:
        """The position from which a view was taken; `check_view` has accepted the view."""
        headings = self._headings_deg(view.telemetry, heading_known)
        smaller = downsampled(view, self.grid.gsd_m)
        rectified = [self.rectified(smaller, heading) for heading in headings]
        refused = check_rectified(rectified[len(headings) // 2], self._min_valid_share)
        if refused is not None:
            return refused
        rows = self._allowed(prior, [each.offset_en_m for each in rectified])
        if rows is not None and rows.size == 0:
            return NoFix("outside_map", "no tile of the map lies within the prior")
        match = self.matcher.match(self.embedded(rectified), rows)
        if not math.isfinite(match.evidence["score"]):
            return NoFix("internal_error", "the map's embeddings are not finite")
        return self._fix(match, rectified[match.query], headings[match.query], view.telemetry)

    def rectified(self, view: View, heading_deg: float) -> RectifiedView:
        """The view under a heading, in size and resolution of a tile."""
        turned = replace(view, telemetry=replace(view.telemetry, yaw_deg=heading_deg))
        return rectify(turned, gsd_m=self.grid.gsd_m, size_px=self.grid.tile_px)

    def embedded(self, views: list[RectifiedView]) -> NDArray[np.float32]:
        """Embeddings (Q, D) of rectified views."""
        return np.stack(
            [
                self.embedder.view(self.representation(view.grey, view.valid), view.valid)
                for view in views
            ]
        )

    def _allowed(
        self, prior: Prior | None, offsets_en_m: list[NDArray[np.float64]]
    ) -> NDArray[np.intp] | None:
        """Rows of tiles that the camera may see: around the prior, displaced by the tilt."""
        if prior is None:
            return None
        offset = np.mean(offsets_en_m, axis=0)
        spread_m = max(float(np.hypot(*(each - offset))) for each in offsets_en_m)
        centre = self.sheet.frame.en_from_latlon(prior.lat_deg, prior.lon_deg) + offset
        radius_m = PRIOR_SIGMAS * max(prior.std_m, 0.0) + self.grid.stride_m + spread_m
        return rows_within(self.centres_en_m, centre, radius_m)

    def _headings_deg(self, telemetry: Telemetry, heading_known: bool) -> list[float]:
        """Headings to try: around the reported one as far as its error reaches, or all."""
        if not heading_known:
            return [float(heading) for heading in np.arange(0, 360, UNKNOWN_HEADING_STEP_DEG)]
        std = telemetry.yaw_std_deg
        if std is None or math.isnan(std):
            std = TILE_YAW_STD_DEG
        std = min(max(std, 0.0), 90.0)
        side = math.floor(HEADING_SIGMAS * std / self._step_deg + 0.5)
        return [telemetry.yaw_deg + k * self._step_deg for k in range(-side, side + 1)]

    def _fix(
        self, match: Match, view: RectifiedView, heading_deg: float, telemetry: Telemetry
    ) -> Fix:
        # The tile shows what the camera looks at; the aircraft lies `offset` before that.
        centre = self.centres_en_m[match.tile].astype(np.float64)
        position = centre + match.shift_en_m - view.offset_en_m
        lat, lon = self.sheet.frame.latlon_from_en(position)
        evidence = {
            **match.evidence,
            "valid_share": float(view.valid.mean()),
            "tile_shift_m": float(np.hypot(*match.shift_en_m)),
        }
        confidence = math.nan if self.confidence is None else self.confidence(evidence)
        covariance = np.eye(2) * self._position_std_m**2
        covariance.flags.writeable = False
        return Fix(
            lat_deg=float(lat),
            lon_deg=float(lon),
            cov_en_m2=covariance,
            confidence=confidence,
            radius_m=self.radius_m,
            heading_deg=heading_deg % 360,
            agl_m=telemetry.agl_m,
            evidence=MappingProxyType(evidence),
        )
