"""From one view to a fix."""

import math
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from orthonav import represent
from orthonav.confidence.logistic import LogisticConfidence
from orthonav.confidence.registered import RegisteredConfidence
from orthonav.embed.stored import embedder_of
from orthonav.errors import MapFileError, VariantError
from orthonav.localizer.checks import check_rectified, check_view
from orthonav.localizer.match import Match, TileMatcher
from orthonav.localizer.propose import TileProposer
from orthonav.localizer.rectify import RectifiedView, downsampled, rectify
from orthonav.localizer.registration import RegistrationLocalizer
from orthonav.mapfile.layer import GreyLayer
from orthonav.mapfile.manifest import SheetInfo
from orthonav.mapfile.reader import MapFile
from orthonav.records import Fix, NoFix, Prior, Telemetry, View
from orthonav.search.exact import rows_within
from orthonav.search.position import PositionRule
from orthonav.variants import variant_from_recipe

DEFAULT_YAW_STD_DEG = 5.0
PRIOR_SIGMAS = 3.0
HEADING_SIGMAS = 1.5
UNKNOWN_HEADING_STEP_DEG = 8.0


class Localizer:
    """Places views on one map. Cheap to make, safe to share between threads once warm."""

    def __init__(
        self,
        opened: MapFile,
        *,
        registration: bool = True,
        position: PositionRule = "peak",
        flying: bool = True,
    ) -> None:
        """Take an opened map; raises `MapFileError` if it cannot be flown with this program.

        Without `registration`, or where the map has no registration layer, views are placed by
        their tiles only; `position` is then how scores of tiles become a position. Without
        `flying`, maps are taken too that look at what is too slow to fly: for experiments with maps
        of one's own, for theirs load networks of this machine. Raises `MissingExtraError` where the
        map's encoder needs onnxruntime and it is not installed.
        """
        manifest = opened.manifest
        if len(manifest.sheets) != 1:
            raise MapFileError(f"this program flies maps of one sheet: {opened.path}")
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
            self._matcher = TileMatcher(self.grid, self.centres_en_m, embeddings, position)
        except MapFileError as error:
            raise MapFileError(f"{error}: {opened.path}") from error
        self.radius_m = manifest.radius_m
        self.index = self._matcher.index
        self.registration = None
        if registration:
            propose = TileProposer.of(
                self.grid,
                self.centres_en_m,
                self.index,
                self.embedder,
                self.representation,
                self._matcher.neighbours,
            )
            self.registration = _registration(opened, self.sheet, propose)

    def locate(
        self,
        view: View,
        *,
        prior: Prior | None = None,
        heading_known: bool = True,
    ) -> Fix | NoFix:
        """Where a view was taken.

        `prior` limits the search to the tiles within three standard deviations of it. With
        `heading_known` false all headings are tried and the reported heading may be NaN. Raises
        `CameraError` if the camera is not that of the image; everything else that is wrong with a
        view makes a `NoFix`.
        """
        refused = check_view(view, self.grid.gsd_m, heading_known)
        if refused is not None:
            return refused
        if self.registration is not None:
            return self.registration.locate(view, prior, heading_known)
        headings = self._headings_deg(view.telemetry, heading_known)
        smaller = downsampled(view, self.grid.gsd_m)
        rectified = [self.rectified(smaller, heading) for heading in headings]
        refused = check_rectified(rectified[len(headings) // 2], self._min_valid_share)
        if refused is not None:
            return refused
        rows = self._allowed(prior, [each.offset_en_m for each in rectified])
        if rows is not None and rows.size == 0:
            return NoFix("outside_map", "no tile of the map lies where the prior says")
        match = self.match(self.embedded(rectified), rows)
        if not math.isfinite(match.evidence["score"]):
            return NoFix("internal_error", "the map's embeddings are not finite")
        return self._fix(match, rectified[match.query], headings[match.query], view.telemetry)

    def rectified(self, view: View, heading_deg: float) -> RectifiedView:
        """The view as one tile of the map would look, under a heading."""
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

    def match(self, queries: NDArray[np.float32], rows: NDArray[np.intp] | None = None) -> Match:
        """Best tile for queries (Q, D) among `rows`: see `TileMatcher.match`."""
        return self._matcher.match(queries, rows)

    def _allowed(
        self, prior: Prior | None, offsets_en_m: list[NDArray[np.float64]]
    ) -> NDArray[np.intp] | None:
        """Rows of tiles that the camera may look at: around the prior, moved by where it tilts."""
        if prior is None:
            return None
        offset = np.mean(offsets_en_m, axis=0)
        spread_m = max(float(np.hypot(*(each - offset))) for each in offsets_en_m)
        centre = self.sheet.frame.en_from_latlon(prior.lat_deg, prior.lon_deg) + offset
        radius_m = PRIOR_SIGMAS * max(prior.std_m, 0.0) + self.grid.stride_m + spread_m
        return rows_within(self.centres_en_m, centre, radius_m)

    def _headings_deg(self, telemetry: Telemetry, heading_known: bool) -> list[float]:
        """Headings to try: around the told one as far as its error reaches, or all."""
        if not heading_known:
            return [float(heading) for heading in np.arange(0, 360, UNKNOWN_HEADING_STEP_DEG)]
        std = telemetry.yaw_std_deg
        if std is None or math.isnan(std):
            std = DEFAULT_YAW_STD_DEG
        std = min(max(std, 0.0), 90.0)
        side = math.floor(HEADING_SIGMAS * std / self._step_deg + 0.5)
        return [telemetry.yaw_deg + k * self._step_deg for k in range(-side, side + 1)]

    def _fix(
        self, match: Match, view: RectifiedView, heading_deg: float, telemetry: Telemetry
    ) -> Fix:
        # The tile shows the ground where the camera looks; the aircraft is `offset` before that.
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


def _registration(
    opened: MapFile, sheet: SheetInfo, propose: TileProposer | None
) -> RegistrationLocalizer | None:
    layer = GreyLayer.of(opened)
    if layer is None:
        return None
    plain = opened.manifest.registration or {}
    try:
        fitted = plain.get("confidence")
        confidence = None if fitted is None else RegisteredConfidence.from_plain(fitted)
        radius_m, floor_px = float(plain["radius_m"]), float(plain["position_floor_px"])
    except (VariantError, KeyError, TypeError, ValueError) as error:
        raise MapFileError(f"map cannot be flown ({error}): {opened.path}") from error
    if not (0 < radius_m < math.inf and 0 <= floor_px < math.inf):
        raise MapFileError(f"map has impossible registration parameters: {opened.path}")
    return RegistrationLocalizer(sheet, layer, confidence, radius_m, floor_px, propose)
