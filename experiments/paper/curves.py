"""Accuracy and loss of networks as they learn: the setting "epochs" as a table and a figure."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib.figure
from benchmarks.record import Table

from experiments.paper.methods import FULL
from experiments.paper.results import Result, of_methods, percent

FIGURE = Path(__file__).resolve().parents[2] / "docs" / "figures" / "epochs.png"
PLACEMENT = "grid"
COLOURS = {"canny": "#0072B2", "gray": "#E69F00"}


def curves(results: Sequence[Result]) -> dict[str, list[tuple[int, Result]]]:
    """Rows of each training by epochs."""
    found: dict[str, list[tuple[int, Result]]] = {}
    for each in of_methods(results):
        if each.method.curve:
            count = each.method.number("epochs")
            found.setdefault(each.method.training, []).append((count, each))
    return {name: sorted(rows, key=lambda row: row[0]) for name, rows in found.items()}


def table(results: Sequence[Result]) -> list[Table]:
    """Accuracy on the grid after some epochs, and the loss of the last of them."""
    made = curves(results)
    if not made:
        return []
    counts = sorted({count for rows in made.values() for count, _ in rows})
    lines = []
    for rows in made.values():
        at = dict(rows)
        cells = [percent(at[n].accuracy(PLACEMENT)) if n in at else "-" for n in counts]
        last = rows[-1][1]
        loss = f"{last.plain['loss'][0]:.3g} to {last.plain['loss'][-1]:.3g}"
        cost = f"{max(each.plain['peak_mb'] for _, each in rows):,}"
        lines.append([_label(last), *cells, loss, cost])
    first = next(iter(made.values()))[0][1]
    notes = (
        f"accuracy at 15 m on the grid of {first.scene} (reduced: {first.plain['tiles']:,} tiles), "
        f"{len(first.plain['views'][PLACEMENT])} views; loss of the first epoch to the last",
        "width 512 and 64: the paper's networks, batches and rates; width 32: the reduced setting",
    )
    header = ("network, epochs:", *map(str, counts), "loss", "peak MB")
    return [Table("Networks as they learn: accuracy at 15 m, %", header, lines, notes)]


def figure(results: Sequence[Result], path: Path) -> None:
    """Accuracy and loss of the auto-encoders by epoch, as a PNG; none without rows."""
    made = [rows for rows in curves(results).values() if rows[0][1].method.family == "autoencoder"]
    if not made:
        return
    drawn = matplotlib.figure.Figure(figsize=(8, 3.4), layout="constrained")
    left, right = drawn.subplots(1, 2)
    for rows in made:
        last = rows[-1][1]
        style = {
            "color": COLOURS[last.method.input],
            "linestyle": "-" if last.method.number("width") == FULL.encoder_width else ":",
            "label": _label(last),
        }
        epochs = [count for count, _ in rows]
        left.plot(epochs, [100 * each.accuracy(PLACEMENT) for _, each in rows], "o", **style)
        loss = last.plain["loss"]
        right.plot(range(1, len(loss) + 1), loss, **style)
    left.set(xlabel="epochs", ylabel="views on the grid within 15 m, %", ylim=(0, None))
    right.set(xlabel="epoch", ylabel="loss (mean squared error)", yscale="log")
    left.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn.savefig(path, dpi=110)


def _label(each: Result) -> str:
    return f"{each.method.label}, width {each.method.number('width')}"
