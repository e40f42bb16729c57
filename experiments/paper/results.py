"""Result files: read, written and kept in the repository; their figures, and names of rows."""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.paper.methods import SETTINGS, Method, Trajectory
from orthonav.core.files import write_text

PROGRAM = "python -m experiments.paper"
ROWS = Path(__file__).resolve().parent / "rows"
"""Results that the page shows, a folder for each setting."""
WORDS = ROWS.with_name("words.json")
"""Results of `python -m experiments.paper.words`."""
DATES = ROWS.with_name("dates.json")
"""How alike two dates look: results of `python -m experiments.paper pictures`."""
BASELINES, FIELD = "baselines", "field"
DIGITS = 5
"""Significant digits of figures in a row: a confidence to 1e-5, an error of 9 km to 0.1 m."""

ACCURACY_M = 15.0
ACCURACY = 0.95
ORDER = attrgetter("method.order")
"""Results are sorted by this in tables."""
COLUMNS = {"error_m": 0, "score": 1, "lowe_ratio": 2, "peak_ratio": 3, "confidence": 4}
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Result:
    """One result file, as it was written."""

    plain: dict[str, Any]

    @property
    def scene(self) -> str:
        """Name of the trajectory or pair of orthophotos."""
        return str(self.plain["scene"])

    @cached_property
    def method(self) -> Method:
        return Method(**self.plain["method"])

    @cached_property
    def trajectory(self) -> Trajectory:
        return Trajectory(**self.plain["trajectory"])

    @property
    def star(self) -> str:
        """A star if the method was tuned on the scene."""
        return "*" if self.method.tuned_on(self.scene) else ""

    @property
    def label(self) -> str:
        """Name of the method in tables, with its star."""
        return self.method.label + self.star

    def column(self, placement: str, name: str) -> Array:
        """A number per view (N,); NaN where there was none, errors then infinite."""
        at = COLUMNS[name]
        values = [row[at] for row in self.plain["views"][placement]]
        return numbers(values, math.inf if name == "error_m" else math.nan)

    def right(self, placement: str) -> NDArray[np.bool_]:
        """Mask (N,) of the views within 15 m."""
        return self.column(placement, "error_m") <= ACCURACY_M

    def accuracy(self, placement: str, radius_m: float = ACCURACY_M) -> float:
        """Share of views within a radius; NaN without any."""
        errors = self.column(placement, "error_m")
        return float((errors <= radius_m).mean()) if errors.size else math.nan


def read(folder: Path) -> list[Result]:
    """All results of a folder, by name of file."""
    paths = sorted(folder.glob("*.json"))
    return [Result(json.loads(path.read_text(encoding="utf-8"))) for path in paths]


def stored() -> list[Result]:
    return [row for name in SETTINGS for row in read(ROWS / name)]


def keep(results: Path, setting: str) -> list[str]:
    """Copy the results of a setting into the repository; the names of the rows that changed."""
    changed = []
    found = [
        (path, ROWS / setting / path.name) for path in sorted((results / setting).glob("*.json"))
    ]
    for path, target in [*found, (results / DATES.name, DATES)]:
        if not path.is_file():
            continue
        text = path.read_text(encoding="utf-8")
        if not target.is_file() or target.read_text(encoding="utf-8") != text:
            target.parent.mkdir(parents=True, exist_ok=True)
            write_text(target, text)
            changed.append(path.stem)
    return changed


def compact(made: dict[str, Any]) -> str:
    """A result as text: one line per field, numbers rounded to five digits."""
    lines = [
        f"{json.dumps(name)}: {json.dumps(rounded(value), separators=(',', ':'))}"
        for name, value in made.items()
    ]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def rounded(value: Any) -> Any:
    """The same with numbers of five digits, and None for those that are not finite."""
    if isinstance(value, dict):
        return {str(key): rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    if not isinstance(value, float):
        return value
    return float(f"{value:.{DIGITS}g}") if abs(value) < float("inf") else None


def of_methods(results: Iterable[Result]) -> list[Result]:
    """Those of one method each, not of the baselines or of the field."""
    return [each for each in results if "method" in each.plain]


def numbers(values: Sequence[float | None], missing: float) -> Array:
    """Numbers (N,) of a JSON list, None as `missing`."""
    return np.array([missing if value is None else value for value in values], np.float64)


def percent(value: float | None) -> str:
    """A share in per cent, "-" where there is none."""
    return "-" if value is None or math.isnan(value) else f"{100 * value:.0f}"


def share(counted: Sequence[int]) -> float:
    """Share of views within 15 m: number of them, and of all."""
    hits, count = counted
    return hits / count if count else math.nan


def share_with_error(right: int, count: int) -> str:
    """A share in per cent with its standard error."""
    mean = share((right, count))
    return with_error(mean, math.sqrt(mean * (1 - mean) / (count or 1)))


def with_error(mean: float, error: float, *, signed: bool = False) -> str:
    """A share or a difference in per cent with its standard error."""
    if math.isnan(mean):
        return "-"
    shown = f"{100 * mean:+.0f}" if signed else percent(mean)
    return f"{shown} ± {percent(error)}"


def mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    """Mean and its standard error; NaN of fewer than two values."""
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
    return (float(np.mean(values)) if values else math.nan), spread / math.sqrt(len(values) or 1)


def difference(one: Result, other: Result, placement: str) -> tuple[float, float]:
    """Mean difference of two results over the same views, and its standard error."""
    pairs = zip(one.right(placement), other.right(placement), strict=True)
    return mean_and_error([float(here) - float(there) for here, there in pairs])


def confident(right: NDArray[np.bool_], ratio: Array, threshold: float) -> tuple[float, float]:
    """Accuracy of the accepted views and the accepted share; accuracy NaN if none is accepted."""
    accepted = ratio >= threshold
    return float(right[accepted].mean()) if accepted.any() else math.nan, float(accepted.mean())


def accepted_at(right: NDArray[np.bool_], ratio: Array, accuracy: float = ACCURACY) -> float:
    """Largest share of views that a threshold on `ratio` keeps with at least that accuracy."""
    thresholds = np.unique(ratio[np.isfinite(ratio)])
    pairs = [confident(right, ratio, threshold) for threshold in thresholds]
    return max((accepted for found, accepted in pairs if found >= accuracy), default=0.0)


def ceiling(stride_m: float) -> float:
    """Accuracy at 15 m of a method that always finds the correct tile, for views anywhere: the
    part of a square of `stride_m` that lies within the circle."""
    axis = (np.arange(400) + 0.5) / 400 * stride_m / 2
    return float((np.hypot(axis[:, None], axis) <= ACCURACY_M).mean())


def best_words(found: Sequence[Result]) -> list[Result]:
    """All but the worse ones of several vocabularies: "the best performances will be displayed"."""
    words = [each for each in found if each.method.family == "bovw"]
    best = max(words, key=lambda each: each.accuracy("grid"), default=None)
    shown = [each for each in found if each.method.family != "bovw" or each is best]
    return sorted(shown, key=ORDER)


def by_scene(results: Iterable[Result]) -> dict[str, list[Result]]:
    """Results of each scene, by its name."""
    scenes: dict[str, list[Result]] = {}
    for each in results:
        scenes.setdefault(each.scene, []).append(each)
    return dict(sorted(scenes.items()))
