"""Synthetic check results for tests of the output files."""

import math

import numpy as np

from orthonav.ground.check.cells import CellGrid
from orthonav.ground.check.estimate import Prediction
from orthonav.ground.check.findings import likely_outages
from orthonav.ground.check.flights import scene_shifts, shifted, simulated
from orthonav.ground.check.records import (
    Along,
    Cells,
    CheckedInputs,
    CheckResult,
    Conditions,
    Range,
    Reason,
    Verdict,
    Word,
)
from orthonav.ground.check.trials import Trial
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Route

FILES = {"index.html", "check.json", "check.tif", "check.geojson"}
EVIL = '</script><script>alert("x")</script><img src=x onerror=alert(1)>'
EVIL += " & ünïcode \u202e\x1b[31m \udc80"
DIGEST = "0123456789abcdef" * 4
CONDITIONS = Conditions(
    width_m=240.0,
    height_m=180.0,
    agl_m=200.0,
    yaw_std_deg=5.0,
    agl_std=0.05,
    prior_std_m=25.0,
    accept=0.9,
    radius_m=35.0,
    speed_mps=22.0,
    drift=0.02,
    alert_limit_m=40.0,
)
GO = Verdict(Word.GO, (Reason("fixes", "A fix is likely along nearly all of the route.", Word.GO),))
NO_GO = Verdict(
    Word.NO_GO,
    (
        Reason("availability", "Positions are rarely available.", Word.NO_GO),
        Reason("dates", "Only the map's own date was tried.", Word.MARGINAL),
        Reason("mean", "The mean probability is high.", Word.GO),
    ),
)


def right(en_m, *, error_m=2.0, expected=0.5):
    return Trial(tuple(en_m), error_m, expected, right=True)


def lost(en_m, *, expected=0.5):
    """A trial without a fix."""
    return Trial(tuple(en_m), math.nan, expected)


def route_of(frame, points_en_m, bands_m=()):
    lat, lon = frame.latlon_from_en(np.array(points_en_m, float))
    return Route(tuple(zip(lat.tolist(), lon.tolist(), strict=True)), leg_bands_m=tuple(bands_m))


def area_of(frame, points_en_m, bands_m=(), band_m=200.0):
    """The bands of the legs between points."""
    points, half = np.array(points_en_m, float), max(bands_m or (band_m,)) / 2
    extent = (*(points.min(axis=0) - half), *(points.max(axis=0) + half))
    return Area(frame, extent, route_of(frame, points, bands_m), 2 * half)


def predicted(probability, error_m):
    """A prediction of these values, with an interval of no width."""
    nothing = np.zeros_like(probability)
    return Prediction(probability, probability, probability, error_m, nothing, nothing)


def straight(probability, step_m=25.0, error_m=3.0):
    """A route to the east with these probabilities."""
    probability = np.array(probability, float)
    distance = np.arange(len(probability)) * step_m
    points = np.stack([distance, np.zeros_like(distance)], axis=1)
    place = vars(predicted(probability, np.full_like(distance, error_m)))
    return Along(distance_m=distance, points_en_m=points, across_low=probability, **place)


def made_cells(rows, cols, side_m, seed=1):
    """Cells of smooth random probabilities around the origin."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(rows + 12, cols + 12))
    smooth = sum(np.roll(noise, (i, j), (0, 1)) for i in range(-4, 5) for j in range(-4, 5)) / 9
    probability = 1 / (1 + np.exp(-(1.6 + 2.2 * smooth[6:-6, 6:-6])))
    spread = 0.12 * np.sqrt(probability * (1 - probability)) * 2
    return Cells(
        grid=CellGrid(-cols * side_m / 2, rows * side_m / 2, side_m, rows, cols),
        probability=probability,
        low=np.clip(probability - spread, 0, 1),
        high=np.clip(probability + spread, 0, 1),
        error_m=2 + 12 * (1 - probability),
        wrong=0.03 * (1 - probability),
        trials=rng.integers(4, 20, (rows, cols)).astype(np.int32),
        persistence=np.clip(probability + 0.1 * rng.normal(size=(rows, cols)), 0, 1),
    )


def lost_in(cells, mask):
    """The same cells, unknown where `mask` is set."""
    hole = np.where(mask, np.nan, 1.0)
    names = ("probability", "low", "high", "error_m", "wrong", "persistence")
    values = {name: getattr(cells, name) * hole for name in names}
    values["trials"] = np.where(mask, 0, cells.trials).astype(np.int32)
    return Cells(grid=cells.grid, **values)


def along_of(cells, waypoints, step_m=25.0):
    legs = np.hypot(*np.diff(waypoints, axis=0).T)
    ends = np.concatenate([[0.0], np.cumsum(legs)])
    distance = np.linspace(0, ends[-1], max(2, round(ends[-1] / step_m)))
    points = np.stack([np.interp(distance, ends, axis) for axis in waypoints.T], axis=1)
    numbers = cells.grid.numbers(points)
    names = ("probability", "low", "high", "error_m", "wrong", "persistence")
    values = {name: getattr(cells, name).ravel()[numbers] for name in names}
    lowest = np.maximum(values["probability"] - 0.15, 0)
    return Along(distance_m=distance, points_en_m=points, across_low=lowest, **values)


def flown(along, conditions=CONDITIONS, scenes_std=0.8, false_fixes=0):
    """Flights along the route."""
    shifts, rng = scene_shifts(scenes_std), np.random.default_rng(1)
    return simulated(along, conditions, shifts, false_fixes, rng)


def made_check(frame, cells, waypoints=None, band_m=None, name="area.onav", route="", **changed):
    """A check of cells, along a route where there is one."""
    along = None if waypoints is None else along_of(cells, waypoints)
    flights = None if along is None else flown(along)
    known = np.isfinite(cells.probability)
    mean = Range.of(shifted(cells.probability[known], scene_shifts(0.8)).sum(axis=1) / known.sum())
    parts = {
        "about": CheckedInputs(
            map_name=name,
            imagery="2016-07.tif 2016-07-15, 1.0 m",
            recipe="gradient, 256 px",
            other_date="2021-10.tif",
            route_name=route,
            command=f"orthonav check {name}",
            version="0.1.0",
            terms=("© IGN, Licence Ouverte 2.0",),
            map_sha256=DIGEST,
        ),
        "conditions": CONDITIONS,
        "verdict": NO_GO,
        "area_km2": float(known.sum() * cells.grid.side_m**2 / 1e6),
        "mean": mean if flights is None else flights.probability,
        "second_date": True,
        "along": along,
        "flights": flights,
        "route_en_m": waypoints,
        "band_m": band_m,
        "outages": () if along is None else likely_outages(along, flights, CONDITIONS),
    }
    return CheckResult(frame=frame, cells=cells, **{**parts, **changed})


def tiny(frame):
    """A map of 0.5 km2, without a route."""
    return made_check(frame, made_cells(14, 14, 50.0), verdict=GO, second_date=False)


def small_route(frame, **changed):
    """A route of some kilometres that ends in an outage, in a band of 300 m."""
    cells = made_cells(20, 20, 50.0, seed=3)
    cells.probability[:, 14:] = 0.02
    cells.low[:, 14:] = 0.01
    cells.high[:, 14:] = 0.04
    waypoints = np.array([(-420.0, -400.0), (-100.0, 300.0), (150.0, -350.0), (440.0, 350.0)])
    return made_check(frame, cells, waypoints, 300.0, route="north loop", **changed)


def nearly_empty(frame):
    """Only a few known cells."""
    cells = made_cells(20, 20, 50.0)
    mask = np.ones((20, 20), dtype=bool)
    mask[3, 4:6] = False
    return made_check(frame, lost_in(cells, mask))
