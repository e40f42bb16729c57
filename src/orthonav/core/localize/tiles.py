"""Placing a view by its tile: embed it under a few headings, and find the most similar tile.

As in Di Piazza et al. 2024, section Methodology, to a fraction of a tile. Maps with a registration
layer use the tiles for candidates only (`TileProposer`)."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError, VariantError
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.confidence import LogisticConfidence
from orthonav.core.localize.view import RectifiedView, check_rectified, downsampled, rectify
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.records import PRIOR_SIGMAS, TILE_YAW_STD_DEG, Fix, NoFix, Prior, Telemetry, View
from orthonav.core.register.search import Peak
from orthonav.core.register.window import Pose
from orthonav.core.tiles import represent
from orthonav.core.tiles.bank import Representation, embed_directions
from orthonav.core.tiles.embed import ViewEmbedder, embedder_of
from orthonav.core.tiles.position import (
    ExactIndex,
    PositionRule,
    TileNeighbours,
    parabola_peak,
    rows_within,
)
from orthonav.core.tiles.whitened import WhitenedEmbedder
from orthonav.core.variants import variant_from_recipe

MAX_RATIO = 10.0  # A rival at or below zero leaves the best without any
HEADING_STEP_DEG = 8.0
"""Where the heading is unknown: embeddings find their tile up to 8 deg off
(docs/decisions/evidence.md)."""


def lowe_ratio(scores: NDArray[np.float32], best: int | None = None) -> float:
    """Best score over second best of tiles (N,), at most `MAX_RATIO`; 1 for a best of 0 or less.

    Equation 3 of Di Piazza et al. 2024, section Methodology, Confidence criterion."""
    if scores.size < 2:
        return MAX_RATIO
    if best is None:
        best = int(scores.argmax())
    others = max(scores[:best].max(initial=-1.0), scores[best + 1 :].max(initial=-1.0))
    return _ratio(float(scores[best]), float(others))


def rival_score(
    scores: NDArray[np.float32], centres_en_m: NDArray[np.float32], best: int, exclusion_m: float
) -> float:
    """Best score farther than `exclusion_m` from the best tile.

    The best score itself where there is none: that must not appear as certainty."""
    offset = centres_en_m - centres_en_m[best]
    is_far = np.einsum("ij,ij->i", offset, offset) > exclusion_m**2
    if not is_far.any():
        return float(scores[best])
    return float(np.max(scores, where=is_far, initial=-1.0))


def _ratio(best: float, second: float) -> float:
    if best <= 0:
        return 1.0
    return min(MAX_RATIO, best / second) if second > 0 else MAX_RATIO


@dataclass(frozen=True, eq=False)
class Match:
    """The best tile (row) for a view, offset from its centre, heading index, and evidence."""

    tile: int
    shift_en_m: tuple[float, float]
    query: int
    evidence: dict[str, float]


class TileMatcher:
    """The tiles of a sheet: centres (N, 2) float32 and embeddings (N, D) float16."""

    def __init__(
        self,
        grid: TileGrid,
        centres_en_m: NDArray[np.float32],
        embeddings: NDArray[np.float16],
        position: PositionRule = "peak",
    ) -> None:
        """Raises `MapFileError` where the centres are not those of the grid."""
        self._position: PositionRule = position
        self.index = ExactIndex(embeddings)
        self.grid = grid
        self.centres_en_m = centres_en_m
        self.neighbours = TileNeighbours(grid, centres_en_m)
        # Of the whole map, evenly spread, for rivals; a narrow prior stays fast.
        step = -(-len(embeddings) // 20_000)
        self._background = np.arange(0, len(embeddings), step, dtype=np.intp)

    def match(self, queries: NDArray[np.float32], rows: NDArray[np.intp] | None = None) -> Match:
        """Best tile for queries (Q, D), one per heading, among `rows` (all where None).

        Evidence: `score` (scalar product), `margin` (over the best farther than half a tile away),
        `lowe_ratio`, `peak_ratio` (the same with that exclusion). Rivals are sought beyond `rows`
        too: a narrow prior leaves none, and that must not appear as certainty."""
        searched = None
        if rows is not None:
            searched = np.union1d(rows, self._background)
        scores = self.index.scores(queries, searched)
        best_heading = scores.argmax(axis=1)
        per_tile = np.take_along_axis(scores, best_heading[:, None], axis=1)[:, 0]
        if searched is None or rows is None:
            centres, best = self.centres_en_m, int(per_tile.argmax())
            tile = best
        else:
            centres, allowed = self.centres_en_m[searched], np.searchsorted(searched, rows)
            best = int(allowed[per_tile[allowed].argmax()])
            tile = int(searched[best])
        score = float(per_tile[best])
        rival = rival_score(per_tile, centres, best, self.grid.tile_m / 2)
        evidence = {
            "score": score,
            "margin": score - rival,
            "lowe_ratio": lowe_ratio(per_tile, best),
            "peak_ratio": _ratio(score, rival),
            "tiles_searched": float(len(per_tile) if rows is None else len(rows)),
        }
        # The background serves as rivals only: a mean of all is one of those that are allowed.
        used, used_rows = per_tile, searched
        if self._position == "weighted" and searched is not None and rows is not None:
            used, used_rows = per_tile[np.searchsorted(searched, rows)], rows
        shift = self.neighbours.offset_en_m(self._position, used, tile, used_rows)
        return Match(tile, shift, int(best_heading[best]), evidence)


@dataclass(frozen=True, eq=False)
class TileProposer:
    """Embeds a view under many directions and finds the most similar tiles of a sheet."""

    tiles: TileMatcher
    embedder: WhitenedEmbedder
    representation: Representation

    @classmethod
    def of(
        cls, tiles: TileMatcher, embedder: ViewEmbedder, representation: Representation
    ) -> "TileProposer | None":
        """None for embeddings that cannot embed a view under many directions at once."""
        if not isinstance(embedder, WhitenedEmbedder):
            return None
        return cls(tiles, embedder, representation)

    def fits(self, side_px: float, view_tiles: tuple[float, float]) -> bool:
        """Whether its side (pixels of the map) is within `view_tiles` tiles."""
        (smallest, largest), tile_px = view_tiles, self.tiles.grid.tile_px
        return smallest * tile_px <= side_px <= largest * tile_px

    def candidates(
        self,
        view: RectifiedView,
        directions: list[tuple[float, float]],
        weights: NDArray[np.float32],
        rows: NDArray[np.intp] | None,
        count: int,
    ) -> list[Peak]:
        """Up to `count` tiles that no tile next to them exceeds, among `rows`, for a view
        heading-up at the map's resolution under headings (rad) and log scales with `weights` (Q,).
        """
        tiles, grid = self.tiles, self.tiles.grid
        queries = embed_directions(
            self.embedder, self.representation, view.grey, view.valid, directions, grid.tile_px
        )
        scores = tiles.index.best(queries * weights[:, None], rows)
        chosen = tiles.neighbours.maxima(scores, count, rows)
        numbers = chosen if rows is None else rows[chosen]
        by_direction = tiles.index.scores(queries, numbers)
        peaks = peak_directions(np.array(directions), by_direction, weights)
        found = []
        for place, tile, (heading_rad, log_scale) in zip(
            chosen, numbers, peaks.tolist(), strict=True
        ):
            shift_m = tiles.neighbours.offset_en_m("peak", scores, int(tile), rows)
            east, north = tiles.centres_en_m[tile] + np.array(shift_m)
            x_px = (float(east) - grid.west_m) / grid.gsd_m
            y_px = (grid.north_m - float(north)) / grid.gsd_m
            pose = Pose(x_px, y_px, heading_rad, log_scale)
            found.append(Peak(float(scores[place]), pose))
        return found


def peak_directions(
    directions: NDArray[np.float64], scores: NDArray[np.float32], weights: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Headings and log scales (N, 2) at the peak of scores (N, Q), by parabolas, or the best
    beside a missing one; weights (Q,) choose it, but do not move it."""
    off = directions - directions[:, None]
    off[..., 0] = np.remainder(off[..., 0] + np.pi, 2 * np.pi) - np.pi
    best, tiles = (scores * weights).argmax(axis=1), np.arange(len(scores))
    peaks: NDArray[np.float64] = directions[best]
    for axis in (0, 1):
        other = np.isclose(off[..., 1 - axis], 0.0)
        beside = []
        for sign in (-1, 1):
            along = sign * off[..., axis]
            away = np.where(other & (along > 1e-9), along, np.inf)
            nearest = away.argmin(axis=1)[best]
            beside.append((nearest, away[best, nearest]))
        (before, back), (after, ahead) = beside
        has_both = np.isfinite(back + ahead)
        around = scores[tiles[:, None], np.stack([before, best, after], axis=1)]
        moved = np.array([parabola_peak(*each) for each in around.tolist()])
        step = np.where(has_both, (back + ahead) / 2, 0.0)
        peaks[:, axis] += np.where(has_both, moved, 0.0) * step
    return peaks


class TileLocalizer:
    """Places views on the tiles of one map; threads may share it."""

    def __init__(self, opened: MapFile, *, position: PositionRule, flying: bool) -> None:
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

    def locate(self, view: View, prior: Prior | None, heading_known: bool) -> Fix | NoFix:
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
        """In size and resolution of a tile."""
        turned = replace(view, telemetry=replace(view.telemetry, yaw_deg=heading_deg))
        return rectify(turned, gsd_m=self.grid.gsd_m, size_px=self.grid.tile_px)

    def embedded(self, views: list[RectifiedView]) -> NDArray[np.float32]:
        return np.stack(
            [
                self.embedder.view(self.representation(view.grey, view.valid), view.valid)
                for view in views
            ]
        )

    def _allowed(
        self, prior: Prior | None, offsets_en_m: list[NDArray[np.float64]]
    ) -> NDArray[np.intp] | None:
        """Around the prior, displaced by the tilt."""
        if prior is None:
            return None
        offset = np.mean(offsets_en_m, axis=0)
        spread_m = max(float(np.hypot(*(each - offset))) for each in offsets_en_m)
        centre = self.sheet.frame.en_from_latlon(prior.lat_deg, prior.lon_deg) + offset
        radius_m = PRIOR_SIGMAS * max(prior.std_m, 0.0) + self.grid.stride_m + spread_m
        return rows_within(self.centres_en_m, centre, radius_m)

    def _headings_deg(self, telemetry: Telemetry, heading_known: bool) -> list[float]:
        """Around the reported one as far as its error reaches, or all."""
        if not heading_known:
            return [float(heading) for heading in np.arange(0, 360, HEADING_STEP_DEG)]
        std = telemetry.yaw_std_deg
        if std is None or math.isnan(std):
            std = TILE_YAW_STD_DEG
        std = min(max(std, 0.0), 90.0)
        # 1.5 standard deviations: three headings at 5 deg (docs/decisions/embedding.md).
        side = math.floor(1.5 * std / self._step_deg + 0.5)
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
            evidence=evidence,
        )
