"""Renews the figures of the documentation, docs/figures, by running the tutorial of the operator.

    PYTHONPATH=. python tools/docs/pictures.py

They are part of the repository, so that its pages can be read there. Pages of the program are
photographed with chromium; where there is none, their figures stay as they are.
"""

import json
import math
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import matplotlib.figure
import numpy as np
import pyproj
import rasterio
from console import ROOT, check_page, read_steps
from lab.landscape import DEFAULT_DATES, generate_area, generate_heights
from matplotlib.patches import Ellipse
from PIL import Image
from rasterio.windows import Window

from orthonav.core.flight import FlightFolder, open_flight, read_image, read_truth
from orthonav.core.flight.fixes import read_results
from orthonav.core.geo.camera import footprint_en_m
from orthonav.core.localize import downsampled, rectify
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix, Telemetry, View
from orthonav.core.tiles import represent
from orthonav.core.variants import make_variant
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.imagery.terrain import open_dem
from orthonav.ground.report.imagery import SheetImagery, as_fixed
from orthonav.ground.simulate.flight import (
    DEFAULT_CAMERA,
    Errors,
    SimulateRequest,
    simulate_flight,
)
from orthonav.ground.view.perspective import map_in_view

TUTORIAL = ROOT / "docs" / "tutorials" / "operator.md"
FIGURES = ROOT / "docs" / "figures"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PAST, PRESENT = "area/2016-07.tif", "area/2021-10.tif"
SHOWN_EN_PX = (560, 300, 640)
"""Part of the area shown for two dates: column, row and side."""
TILE_EN_PX = (690, 420, 256)
"""The tile whose representations are shown."""
WINDOW_M, ZOOM_M = 460.0, 36.0
TRUE, FIXED = "#E69F00", "#0072B2"
SIGMAS_95 = math.sqrt(-2 * math.log(0.05))
TOWN_SEED, TOWN_SIDE_M, TOWN_AGL_M, TOWN_PITCH_DEG, TOWN_VIEWS = 25, 400.0, 80.0, 30.0, 8
BROWSER_S = 90
JPEG: dict[str, Any] = {"quality": 80, "optimize": True}
WIDEST_PX = 1200
COLOURS = 192


def main() -> int:
    """Make all figures."""
    FIGURES.mkdir(exist_ok=True)
    steps = [step for step in read_steps(TUTORIAL.read_text("utf-8")) if step.is_run]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "tutorial"
        print(f"running {TUTORIAL.relative_to(ROOT)} for its figures", flush=True)
        differences = check_page(TUTORIAL, folder, steps)
        if differences:
            print("\n".join(differences), file=sys.stderr)
            print("printed otherwise than shown: python tools/docs/console.py --update PAGE")
            return 1
        _draw(folder)
        _figure("town.jpg", (11, 3.2), lambda figure: _draw_town(figure, Path(name) / "town"))
        _photograph(folder)
    return 0


def _draw(folder: Path) -> None:
    """All that needs no browser."""
    _figure("landscape.jpg", (9, 4.7), lambda figure: _draw_landscape(figure, folder))
    _figure("evidence.jpg", (9, 6.5), lambda figure: _draw_evidence(figure, folder))
    _figure("fix.jpg", (9, 9.2), lambda figure: _draw_fix(figure, folder))
    _shrink(folder / "report" / "figures" / "reliability.png", FIGURES / "reliability.png")


def _figure(name: str, size_in: tuple[float, float], draw: Callable[[Any], None]) -> None:
    figure = matplotlib.figure.Figure(size_in, layout="constrained")
    draw(figure)
    figure.savefig(FIGURES / name, dpi=110, facecolor="white", pil_kwargs=JPEG)


def _shrink(source: Path, out: Path) -> None:
    """A copy of a picture of few bytes, because the repository keeps every version of it."""
    picture = Image.open(source).convert("RGB")
    picture.thumbnail((WIDEST_PX, WIDEST_PX))
    few = picture.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(out, optimize=True)


def _read(path: Path, left: float, top: float, side: float) -> np.ndarray:
    """Colours (H, W, 3) of a square window of an orthophoto, in pixels."""
    with rasterio.open(path) as data:
        window = Window(round(left), round(top), round(side), round(side))
        return np.moveaxis(data.read((1, 2, 3), window=window, boundless=True), 0, -1)


def _show(axes: Any, picture: np.ndarray, title: str, **more: Any) -> None:
    axes.imshow(picture, **more)
    axes.set_title(title, fontsize=11)
    axes.set_xticks([])
    axes.set_yticks([])


def _draw_landscape(figure: Any, folder: Path) -> None:
    shown = ((PAST, "July 2016: the map"), (PRESENT, "October 2021: the flight"))
    for axes, (name, title) in zip(figure.subplots(1, 2), shown, strict=True):
        _show(axes, _read(folder / name, *SHOWN_EN_PX), title)


def _draw_evidence(figure: Any, folder: Path) -> None:
    """A tile at both dates: grey levels, Canny edges, oriented gradients."""
    for row, (name, year) in enumerate(((PAST, "2016"), (PRESENT, "2021"))):
        grey = cv2.cvtColor(_read(folder / name, *TILE_EN_PX), cv2.COLOR_RGB2GRAY)
        valid = np.ones(grey.shape, bool)
        edges = make_variant(represent.TABLE, "canny")(grey, valid)[0]
        gradients = make_variant(represent.TABLE, "gradient")(grey, valid)
        turn = np.arctan2(gradients[2], gradients[1]) % (2 * np.pi)
        value = np.clip(gradients[0] / np.percentile(gradients[0], 97), 0, 1)
        planes = (turn / (2 * np.pi) * 179, np.full(grey.shape, 200), value * 255)
        hsv = np.dstack(planes).astype(np.uint8)
        axes = figure.add_subplot(2, 3, 3 * row + 1)
        _show(axes, grey, f"{year}, grey levels", cmap="gray")
        _show(figure.add_subplot(2, 3, 3 * row + 2), edges, f"{year}, Canny edges", cmap="gray")
        axes = figure.add_subplot(2, 3, 3 * row + 3)
        _show(axes, cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), f"{year}, oriented gradients")


def _draw_fix(figure: Any, folder: Path) -> None:
    """One view: as taken, rotated north up, its position on the map, and a detail of the fix."""
    flight = open_flight(folder / "flight")
    fix, telemetry = _usual_fix(folder, flight)
    picture = read_image(folder / "flight" / "frames" / fix["frame"])
    place = _Place(folder / PAST, fix)
    taken, north, wide, near = figure.subplots(2, 2).ravel()
    _show(taken, picture, "the view, October 2021", cmap="gray")
    _show(
        north,
        _north_up(picture, flight, fix, telemetry),
        "rotated north up, at the map's scale",
        cmap="gray",
    )
    true_en_m = place.en_of(*read_truth(folder / "flight" / "truth.csv")[fix["frame"]])
    _show_place(wide, place, WINDOW_M, "its position on the map of July 2016")
    outline = footprint_en_m(flight.camera, fix["heading_deg"], 0.0, 0.0, fix["agl_m"])
    wide.plot(*np.vstack([outline, outline[:1]]).T, color=FIXED, linewidth=2)
    wide.plot(0, 0, "+", color=FIXED, markersize=16, markeredgewidth=2.5)
    title = f"detail: {math.hypot(*true_en_m):.1f} m off, confidence {fix['confidence']:.2f}"
    _show_place(near, place, ZOOM_M, title)
    values, vectors = np.linalg.eigh(np.array(fix["cov_en_m2"]))
    sides = 2 * SIGMAS_95 * np.sqrt(values)
    turn = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    near.add_patch(Ellipse((0, 0), sides[1], sides[0], angle=turn, fill=False, color=FIXED, lw=2))
    near.plot(0, 0, "+", color=FIXED, markersize=18, markeredgewidth=2.5, label="fix, 95 % ellipse")
    near.plot(*true_en_m, "o", color=TRUE, markersize=10, label="ground truth")
    near.legend(loc="lower right")


class _Place:
    """The surroundings of a fix on an orthophoto, metres east and north of it."""

    def __init__(self, ortho: Path, fix: dict[str, Any]) -> None:
        self.ortho = ortho
        with rasterio.open(ortho) as data:
            self.to_crs = pyproj.Transformer.from_crs("EPSG:4326", data.crs, always_xy=True)
            self.transform = data.transform
        self.x_m, self.y_m = self.to_crs.transform(fix["lon_deg"], fix["lat_deg"])

    def en_of(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        x_m, y_m = self.to_crs.transform(lon_deg, lat_deg)
        return x_m - self.x_m, y_m - self.y_m

    def window(self, side_m: float) -> np.ndarray:
        column, row = ~self.transform @ (self.x_m, self.y_m)
        side = side_m / self.transform.a
        return _read(self.ortho, column - side / 2, row - side / 2, side)


def _show_place(axes: Any, place: _Place, side_m: float, title: str) -> None:
    half = side_m / 2
    _show(axes, place.window(side_m), title, extent=(-half, half, -half, half))


def _usual_fix(folder: Path, flight: FlightFolder) -> tuple[dict[str, Any], Telemetry]:
    """A typical confident fix: that with the median error ellipse."""
    lines = (folder / "fixes.jsonl").read_text("utf-8").splitlines()
    reported = {view.frame: view.telemetry for view in flight.views}
    fixes = [fix for fix in map(json.loads, lines) if (fix["confidence"] or 0) > 0.98]
    fixes = [fix for fix in fixes if 20 < fix["heading_deg"] % 90 < 70] or fixes
    fixes.sort(key=lambda fix: np.trace(fix["cov_en_m2"]))
    fix = fixes[len(fixes) // 2]
    return fix, reported[fix["frame"]]


def _north_up(
    picture: np.ndarray, flight: FlightFolder, fix: dict[str, Any], reported: Telemetry
) -> np.ndarray:
    """A view as the map would show it, by the heading and height of its fix."""
    telemetry = replace(reported, yaw_deg=fix["heading_deg"], agl_m=fix["agl_m"])
    view = downsampled(View(picture, flight.camera, telemetry), 1.0)
    turned = rectify(view, gsd_m=1.0, size_px=round(WINDOW_M))
    return np.where(turned.valid, turned.grey, 255)


def _draw_town(figure: Any, folder: Path) -> None:
    """A view over houses, the map as the camera would see it from the fix, and both as one."""
    past, present = DEFAULT_DATES[:2]
    area = {"size_m": (TOWN_SIDE_M, TOWN_SIDE_M), "gsd_m": 0.2, "seed": TOWN_SEED}
    generate_area(folder, dates=[past, present], **area)
    generate_heights(folder, dates=[past, present], slope=0.02, **area)
    town = folder / "town.onav"
    surface = [folder / f"{past.name}_dsm.tif"]
    build_map(BuildRequest([folder / f"{past.name}.tif"], town, surface=surface))
    request = SimulateRequest(
        [folder / f"{present.name}.tif"],
        folder / "flight",
        random=TOWN_VIEWS,
        agl_m=TOWN_AGL_M,
        camera=DEFAULT_CAMERA.fitted(640, 480),
        errors=Errors(yaw_std_deg=10.0, agl_std=0.1, mount_std_deg=1.0),
        surface=[open_dem(folder / f"{present.name}_dsm.tif")],
        camera_pitch_deg=TOWN_PITCH_DEG,
    )
    simulate_flight(request)
    fixes = folder / "fixes.jsonl"
    command = [Path(sys.executable).with_name("orthonav"), "localize", "-q", town]
    subprocess.run([*command, folder / "flight", "--out", fixes], check=True)
    flight, sheet = open_flight(folder / "flight"), SheetImagery(open_map(town))
    views = {each.frame: each for each in flight.views}
    found = [each for each in read_results(fixes) if isinstance(each.outcome, Fix)]
    if not found:
        raise SystemExit("no view over the town was placed")
    result = max(found, key=lambda each: each.outcome.confidence)  # the figure shows a good one
    view, fix = views[result.frame], result.outcome
    truth = read_truth(folder / "flight" / "truth.csv")[result.frame]
    place, true = (
        np.asarray(sheet.frame.en_from_latlon(*at)) for at in ((fix.lat_deg, fix.lon_deg), truth)
    )
    mapped, valid = map_in_view(sheet, flight.camera, as_fixed(view.telemetry, result), place)
    off_m = float(np.hypot(*(place - true)))
    axes = figure.subplots(1, 3)
    _show(axes[0], view.grey(), "the view, October 2021", cmap="gray")
    title = f"the map of July 2016 from the fix, {off_m:.1f} m off"
    _show(axes[1], np.where(valid, mapped, 255), title, cmap="gray")
    both = np.dstack([view.grey(), mapped, mapped])
    _show(axes[2], np.where(valid[..., None], both, 255), "red: the view, cyan: the map")


def _photograph(folder: Path) -> None:
    """Pages of the program, where there is a browser."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        print("no chromium: figures of pages stay as they are", flush=True)
        return
    report = folder / "check" / "index.html"
    if report.is_file():
        _shoot(browser, report.as_uri(), FIGURES / "check.png", (1180, 900))
    command = [Path(sys.executable).with_name("orthonav"), "view", "tracked.jsonl"]
    command += ["--map", "area.onav", "--flight", "flight"]
    server = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, encoding="utf-8")
    try:
        address = (server.stdout.readline() if server.stdout else "").split()
        if address:
            _shoot(browser, address[0], FIGURES / "view.png", (1200, 800))
    finally:
        server.terminate()
        server.wait(timeout=BROWSER_S)


def _shoot(browser: str, address: str, out: Path, size_px: tuple[int, int]) -> None:
    """A picture of a page; if the browser fails, the figure stays as it is."""
    with tempfile.TemporaryDirectory() as profile:
        taken = Path(profile) / "page.png"
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        command += [f"--user-data-dir={profile}", f"--window-size={size_px[0]},{size_px[1]}"]
        command += ["--virtual-time-budget=20000", f"--screenshot={taken}", address]
        try:
            subprocess.run(command, capture_output=True, timeout=BROWSER_S, check=True)
            _shrink(taken, out)
        except (subprocess.SubprocessError, OSError) as error:
            print(f"{out.name} is not renewed: {error}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
