"""Writing a flight folder."""

import csv
import dataclasses
import json
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import OutputError
from orthonav.core.flight.folder import OPTIONAL_COLUMNS, TELEMETRY_COLUMNS
from orthonav.core.geo.camera import Camera
from orthonav.core.records import Telemetry


class FlightWriter:
    """Writes views into an existing empty folder; `close` writes telemetry, camera and truth.

    Use it inside `orthonav.core.files.replacing_folder`, so that it is written whole or not at all.
    """

    def __init__(self, folder: Path, camera: Camera, note: str) -> None:
        self._folder = Path(folder)
        self._camera = camera
        self._note = note
        self._rows: list[dict[str, Any]] = []
        self._truth: list[tuple[str, str, str]] = []
        (self._folder / "frames").mkdir()

    def add(
        self,
        frame: str,
        image: NDArray[np.uint8],
        telemetry: Telemetry,
        truth_latlon_deg: tuple[float, float],
        jpeg_quality: int = 90,
    ) -> None:
        """Add one view: `image` (H, W, 3) RGB, JPEG or PNG by the ending of `frame`."""
        data = encoded(np.ascontiguousarray(image[..., ::-1]), frame, jpeg_quality)
        self.add_encoded(frame, data, telemetry, truth_latlon_deg)

    def add_encoded(
        self,
        frame: str,
        data: bytes,
        telemetry: Telemetry,
        truth_latlon_deg: tuple[float, float] | None,
    ) -> None:
        """Add one view whose image is encoded already, as `data`; its truth where known."""
        path = self._folder / "frames" / frame
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        self._rows.append({"frame": frame, **_columns(telemetry)})
        if truth_latlon_deg is not None:
            lat, lon = truth_latlon_deg
            self._truth.append((frame, f"{lat:.8f}", f"{lon:.8f}"))

    def close(self) -> None:
        """Write `telemetry.csv`, `flight.json` and, where any is known, `truth.csv`."""
        used = [
            name for name in OPTIONAL_COLUMNS if any(row[name] is not None for row in self._rows)
        ]
        columns = [*TELEMETRY_COLUMNS, *used]
        table = [[_text(row[name]) for name in columns] for row in self._rows]
        _write_csv(self._folder / "telemetry.csv", columns, table)
        if self._truth:
            _write_csv(self._folder / "truth.csv", ("frame", "lat_deg", "lon_deg"), self._truth)
        camera = dataclasses.asdict(self._camera)
        text = json.dumps({"camera": camera, "note": self._note}, indent=1)
        (self._folder / "flight.json").write_text(text + "\n", encoding="utf-8")


def encoded(image: NDArray[np.uint8], frame: str, jpeg_quality: int = 90) -> bytes:
    """`image` (H, W) grey or (H, W, 3) BGR encoded by the ending of `frame`.

    Raises `OutputError` where OpenCV cannot encode it.
    """
    options = [int(cv2.IMWRITE_JPEG_QUALITY), jpeg_quality]
    if not frame.lower().endswith((".jpg", ".jpeg")):
        options = []
    done, data = cv2.imencode(Path(frame).suffix, image, options)
    if not done:
        raise OutputError(f"image cannot be encoded: {frame}")
    return data.tobytes()


def _columns(telemetry: Telemetry) -> dict[str, Any]:
    prior, velocity = telemetry.prior, telemetry.vel_en_mps
    return {
        "time_s": Decimal(telemetry.time_ns) / 10**9,
        "yaw_deg": telemetry.yaw_deg,
        "pitch_deg": telemetry.pitch_deg,
        "roll_deg": telemetry.roll_deg,
        "agl_m": telemetry.agl_m,
        "yaw_std_deg": telemetry.yaw_std_deg,
        "agl_std_m": telemetry.agl_std_m,
        "prior_lat_deg": prior and prior.lat_deg,
        "prior_lon_deg": prior and prior.lon_deg,
        "prior_std_m": prior and prior.std_m,
        "vel_east_mps": velocity and velocity[0],
        "vel_north_mps": velocity and velocity[1],
        "tilt_std_deg": telemetry.tilt_std_deg,
        "vel_std_mps": telemetry.vel_std_mps,
        "home_m": telemetry.home_m,
        "amsl_m": telemetry.amsl_m,
        "hae_m": telemetry.hae_m,
    }


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, Decimal):
        return f"{value:.9f}".rstrip("0").rstrip(".")
    return f"{value:.8f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)


def _write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
