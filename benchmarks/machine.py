"""What the machine itself can do: the floors that measurements are held against."""

import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

Made = TypeVar("Made")


def seconds(run: Callable[..., object], *arguments: Any) -> float:
    """Wall time of one call."""
    return timed(run, *arguments)[1]


def timed(run: Callable[..., Made], *arguments: Any) -> tuple[Made, float]:
    """Result of one call, and its wall time in seconds."""
    start = time.perf_counter()
    made = run(*arguments)
    return made, time.perf_counter() - start


def reading_gb_per_s(size_bytes: int) -> float:
    """Rate at which one core reads an array of a size again and again, best of several.

    A scalar product of the array's halves: nothing is written.
    """
    half = np.ones(max(1, size_bytes // 8), dtype=np.float32)
    other = half.copy()
    best = min(seconds(lambda: float(half @ other)) for _ in range(7))
    return 2 * half.nbytes / best / 1e9


def multiplying_gflops() -> float:
    """Rate of one core's float32 matrix product, best of several."""
    a = np.ones((1024, 1024), dtype=np.float32)
    best = min(seconds(lambda: a @ a) for _ in range(5))
    return float(2 * 1024**3 / best / 1e9)
