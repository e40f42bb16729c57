"""`python -m benchmarks.fft`: the transforms of the search by scipy, numpy and OpenCV.

One pose of `orthonav.register.search`: three channels of a view transformed along both axes,
multiplied with the spectra of a window, summed, and transformed back. Processor time, so that other
work on the machine counts little. Decides which library the search uses.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from benchmarks.record import Section, Table, number, provenance, save

SIZES = ((240, 100), (432, 160), (1000, 220), (2000, 220))
"""Sides of windows and of the views laid on them, px: near a prior, up to whole maps."""
CHANNELS = 3
REPEATS = 15
Array = NDArray[Any]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.fft", description=str(__doc__).splitlines()[0]
    )
    parser.add_argument("--out", type=Path, default=Path("bench_results"))
    options = parser.parse_args(arguments)
    start, started = time.perf_counter(), provenance("fft")
    cv2.setNumThreads(1)
    section = measure(SIZES, REPEATS)
    print(section.markdown())
    for path in save(
        options.out, [section], started, wall_s=time.perf_counter() - start, latest=False
    ):
        print(path, file=sys.stderr)
    return 0


def measure(sizes: Sequence[tuple[int, int]], repeats: int) -> Section:
    """Milliseconds of one pose, the least of `repeats`, by library and size."""
    section, rows = Section("Transforms of the search"), []
    for side, view in sizes:
        row = [f"{side} x {side}", str(view)]
        for name, pose in poses(side, view).items():
            pose()
            took_ms = min(_cpu_seconds(pose) for _ in range(repeats)) * 1e3
            section.add(f"{name} {side}", "ms", [took_ms], data=f"{side} px", seed=0)
            row.append(number(took_ms))
        rows.append(row)
    header = ("window, px", "view, px", "scipy, ms", "numpy, ms", "OpenCV, ms")
    notes = (f"one pose, {CHANNELS} channels, float32, processor time, the least of {repeats}",)
    section.tables = [Table("Transforms of the search", header, rows, notes)]
    return section


def _cpu_seconds(pose: Callable[[], Array]) -> float:
    start = time.thread_time()
    pose()
    return time.thread_time() - start


def poses(side: int, view: int) -> dict[str, Callable[[], Array]]:
    """The same scores (side, side), by three libraries."""
    rng = np.random.default_rng(0)
    strip = rng.standard_normal((CHANNELS, view, side)).astype(np.float32)
    window = rng.standard_normal((CHANNELS, side, side)).astype(np.float32)
    return {
        "scipy": _by_planes(scipy.fft, strip, window),
        "numpy": _by_planes(np.fft, strip, window),
        "OpenCV": _by_opencv(strip, window),
    }


def _by_planes(library: Any, strip: Array, window: Array) -> Callable[[], Array]:
    side, view = window.shape[1], strip.shape[1]
    spectra = library.rfft2(window).astype(np.complex64)
    planes = np.zeros(spectra.shape, np.complex64)

    def pose() -> Array:
        planes[:, :view] = library.rfft(strip, axis=2)
        total = np.zeros(spectra.shape[1:], np.complex64)
        for spectrum, of_view in zip(spectra, library.fft(planes, axis=1), strict=True):
            total += spectrum * of_view
        return np.asarray(library.irfft2(total, s=(side, side)), np.float32)

    return pose


def _by_opencv(strip: Array, window: Array) -> Callable[[], Array]:
    side, view = window.shape[1], strip.shape[1]
    spectra = [cv2.dft(plane) for plane in window]
    plane = np.zeros((side, side), np.float32)

    def pose() -> Array:
        total = np.zeros((side, side), np.float32)
        for channel, spectrum in zip(strip, spectra, strict=True):
            plane[:view] = channel
            total += cv2.mulSpectrums(spectrum, cv2.dft(plane, nonzeroRows=view), 0)
        return np.asarray(cv2.idft(total, flags=cv2.DFT_SCALE))

    return pose


if __name__ == "__main__":
    sys.exit(main())
