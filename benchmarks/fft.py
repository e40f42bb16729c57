"""`python -m benchmarks.fft`: the transforms of the search by our kernel, scipy, numpy and OpenCV.

One pose of `orthonav.core.register.search`: three channels of a view transformed along both axes,
multiplied with the spectra of a window, summed, and transformed back. The kernel also cuts the view
under its pose and compares the scores with the best so far, so it does more. Processor time, so
that other work on the machine counts little. Decides what the search uses.
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
from orthonav.core.register.kernel import KERNEL
from orthonav.core.register.search import SearchWindow

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
    header = ("window, px", "view, px", *(f"{name}, ms" for name in poses(*SIZES[0])))
    notes = (
        f"one pose, {CHANNELS} channels, float32, processor time, the least of {repeats}",
        "kernel: with cutting the view under its pose, and the best score at every place",
    )
    section.tables = [Table("Transforms of the search", header, rows, notes)]
    return section


def _cpu_seconds(pose: Callable[[], Array]) -> float:
    start = time.thread_time()
    pose()
    return time.thread_time() - start


def poses(side: int, view: int) -> dict[str, Callable[[], Array]]:
    """One pose by the kernel, where it was compiled, and its transforms by three libraries."""
    rng = np.random.default_rng(0)
    strip = rng.standard_normal((CHANNELS, view, side)).astype(np.float32)
    window = rng.standard_normal((CHANNELS, side, side)).astype(np.float32)
    compiled = {} if KERNEL is None else {"kernel": _by_kernel(side, view)}
    return compiled | {
        "scipy": _by_planes(scipy.fft, strip, window),
        "numpy": _by_planes(np.fft, strip, window),
        "OpenCV": _by_opencv(strip, window),
    }


def _by_kernel(side: int, view: int) -> Callable[[], Array]:
    """`view` px is the diagonal of the view, as far as it reaches under any heading."""
    rng = np.random.default_rng(0)
    made = rng.standard_normal((side, side, 4)).astype(np.float32)
    made[..., 3] = 1.0
    spectra = SearchWindow(made, 0, 0, 0, 1).spectra_by_columns
    across = round(view / 2**0.5)
    values = np.ascontiguousarray(made[:across, :across])
    best = np.full((-(-side // 16), side, 16), -np.inf, np.float32)
    numbers = np.zeros(best.shape, np.int32)
    tried = np.array([(0.3, 0.0, -np.inf, np.inf)])

    def pose() -> Array:
        KERNEL.search(spectra, values, (1.0, 0.6), tried, 0, best, numbers, None)
        return best

    return pose


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
