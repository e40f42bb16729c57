"""The sensitivity figure and the curves of the confidence criteria, as PNG."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from experiments.paper.labels import EDGES, FAMILIES
from experiments.paper.published import LOWE
from experiments.paper.results import Result, confident, share

COLOURS = {
    "gray": "tab:gray",
    "canny": "tab:blue",
    "segments": "tab:orange",
    "sam": "tab:red",
    "sam-tile": "tab:pink",
    "onnx": "tab:olive",
}
OTHER = "tab:green"
SWEPT = ("autoencoder", "triplet", "caevl", "gradient")
STEPS = (("heading_deg", "heading error, deg"), ("drop_m", "height below the reported one, m"))
RATIOS = (("lowe_ratio", "Lowe's ratio"), ("peak_ratio", "excluding half a tile"))


def draw(results: Sequence[Result], folder: Path) -> list[Path]:
    """Write the plots that the results allow and name them."""
    swept = [each for each in results if each.plain.get("sweep")]
    paths = [_sensitivity(swept, folder / "sensitivity.png")] if swept else []
    scenes = sorted({each.scene for each in results})
    for scene in scenes:
        found = [e for e in results if e.scene == scene and e.family == "autoencoder"]
        if found:
            paths.append(_curves(found, folder / f"confidence-{scene}.png"))
    return paths


def _sensitivity(results: Sequence[Result], out: Path) -> Path:
    """Accuracy at 15 m against heading and height errors, a column per method."""
    figure, axes = plt.subplots(
        2, len(SWEPT), figsize=(14, 6), sharey=True, layout="constrained", squeeze=False
    )
    for column, family in enumerate(SWEPT):
        for row, (step, label) in enumerate(STEPS):
            axis = axes[row, column]
            for each in (e for e in results if e.family == family):
                sweep = each.plain["sweep"][step]
                values = [100 * share(errors) for errors in sweep.values()]
                name = "default" if each.registration else EDGES[each.edges]
                colour = "tab:purple" if each.registration else COLOURS.get(each.edges, OTHER)
                axis.plot([float(v) for v in sweep], values, "o-", ms=3, color=colour, label=name)
            axis.set_xlabel(label)
            axis.set_ylim(0, 102)
            axis.grid(alpha=0.3)
            if axis.lines:
                axis.legend(fontsize=8)
        axes[0, column].set_title(FAMILIES[family])
    for row in range(2):
        axes[row, 0].set_ylabel("within 15 m, %")
    return _saved(figure, out)


def _curves(results: Sequence[Result], out: Path) -> Path:
    """Accuracy and accepted share over the threshold, for both ratios; views on the grid."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
    for axis, (ratio, label) in zip(axes, RATIOS, strict=True):
        for each in results:
            right, values = each.right("grid"), each.column("grid", ratio)
            thresholds = np.linspace(1, 2, 101)
            pairs = np.array([confident(right, values, t) for t in thresholds]) * 100
            colour, name = COLOURS[each.edges], EDGES[each.edges]
            axis.plot(thresholds, pairs[:, 0], color=colour, label=f"{name}: correct of accepted")
            axis.plot(thresholds, pairs[:, 1], "--", color=colour, label=f"{name}: accepted")
        if ratio == "lowe_ratio":
            axis.axvline(LOWE, color="black", lw=0.8)
        axis.set_xlabel(label)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("%")
    axes[1].legend(fontsize=7)
    figure.suptitle(f"{FAMILIES['autoencoder']}, {results[0].scene}")
    return _saved(figure, out)


def _saved(figure: Figure, out: Path) -> Path:
    figure.savefig(out, dpi=110)
    plt.close(figure)
    return out
