"""Results in the repository: one small file per row, and what has changed since it was made.

A row names the code it was made with: a digest of every source file that decides its figures.
"""

import ast
import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from experiments.paper.methods import (
    CANNY,
    DEFAULT,
    FIELD_SCENES,
    GREY,
    LEARNT,
    SAM,
    SEGMENTS,
    Method,
    column,
    methods,
)
from experiments.paper.results import Result, read
from experiments.paper.scenes import REDUCED_REAL, SEED, UNTUNED
from experiments.paper.trajectories import REDUCED, SETTINGS, TABLE_1
from orthonav.files import write_text

ROOT = Path(__file__).resolve().parents[2]
ROWS = Path(__file__).resolve().parent / "rows"
BASELINES, FIELD = "baselines", "field"
TRIED = "tried"
"""Folder of rows of another training than a setting's, from which the setting was chosen."""
DIGITS = 5
"""Significant digits of figures in a row: a confidence to 1e-5, an error of 9 km to 0.1 m."""

PROTOCOL = ("experiments/paper/views.py", "experiments/paper/runs.py")
GENERATED = "generated landscape"
"""In place of the files that draw generated scenes: grey levels of ground that they draw."""
DRAWN_PX, DRAWN_GSD_M, DRAWN_FROM_M = 256, (0.2, 1.0, 2.0), (300.0, 900.0)
"""Side and ground resolutions of that ground, and how far it lies from the landscape's origin."""
SAME_GREY = 0.2
"""Difference up to which means and standard deviations of drawn ground are the same.

Processors round single pixels differently. A change of the generator moves houses or texture, and
with them the figures of some quarter.
"""
TILES = (
    "src/orthonav/localizer/match.py",
    "src/orthonav/localizer/rectify.py",
    "src/orthonav/localizer/tiles.py",
    "src/orthonav/search/*.py",
)
NETWORK = (
    "src/orthonav/embed/network.py",
    "src/orthonav/neural/tiles.py",
    "src/orthonav/neural/training.py",
)
FAMILY = {
    "gradient": ("src/orthonav/embed/cells.py", "src/orthonav/embed/whitened.py"),
    "bovw": ("src/orthonav/embed/words.py", "src/orthonav/neural/words.py"),
    "autoencoder": (*NETWORK, "src/orthonav/neural/autoencoder.py"),
    "triplet": (
        *NETWORK,
        "src/orthonav/neural/triplet.py",
        "src/orthonav/prepare/change.py",
        "src/orthonav/prepare/encoders.py",
    ),
    "caevl": (
        *NETWORK,
        "src/orthonav/embed/caevl.py",
        "src/orthonav/neural/augment.py",
        "src/orthonav/neural/autoencoder.py",
        "src/orthonav/neural/caevl.py",
        "src/orthonav/neural/vicreg.py",
    ),
    BASELINES: ("benchmarks/posed.py", "experiments/paper/baselines.py"),
    FIELD: (
        "benchmarks/posed.py",
        "experiments/paper/field.py",
        "experiments/paper/matchers.py",
    ),
}
EDGES = {
    DEFAULT: ("src/orthonav/represent/gradients.py",),
    GREY: ("src/orthonav/represent/gray.py",),
    CANNY: ("src/orthonav/represent/canny.py",),
    SEGMENTS: ("src/orthonav/represent/segments.py",),
    SAM: ("src/orthonav/neural/sam.py",),
    LEARNT: ("src/orthonav/represent/learned.py", "experiments/paper/between_dates.onnx"),
}
PART_OF = {"encoder_": ("autoencoder", "caevl"), "triplet_": ("triplet",), "words": ("bovw",)}
"""Which families a part of a setting decides, by the beginning of its name; others decide all."""
REGISTRATION = (
    "src/orthonav/confidence/*.py",
    "src/orthonav/localizer/*.py",
    "src/orthonav/register/*.py",
)
TRACKED = tuple(f"src/orthonav/localizer/{name}.py" for name in ("odometry", "places", "tracker"))
"""Files among those that place no single view, and so decide no row."""


def code(family: str, edges: str, *, registration: bool, generated: bool) -> dict[str, str]:
    """Digests of the files that decide the figures of a row, by path in the repository."""
    patterns = [*PROTOCOL, *FAMILY[family], *(REGISTRATION if registration else TILES)]
    patterns += EDGES[edges.partition(":")[0]] if edges else ()
    paths = {path for pattern in patterns for path in ROOT.glob(pattern)}
    paths -= {ROOT / path for path in TRACKED}
    found = {path.relative_to(ROOT).as_posix(): _digest(path) for path in sorted(paths)}
    return found | ({GENERATED: _drawn()} if generated else {})


@lru_cache
def _drawn() -> str:
    """Means and standard deviations of the grey levels of the quarters of some generated ground,
    at every date and resolution."""
    from lab.landscape import DEFAULT_DATES, ORIGIN_M, Landscape

    made, levels = Landscape(SEED), []
    west_m, north_m = (origin + off for origin, off in zip(ORIGIN_M, DRAWN_FROM_M, strict=True))
    half = DRAWN_PX // 2
    for gsd_m in DRAWN_GSD_M:
        for date in DEFAULT_DATES:
            picture = made.render(date, west_m, north_m, DRAWN_PX, DRAWN_PX, gsd_m)
            quarters = picture.reshape(2, half, 2, half, -1)
            for figure in (np.mean, np.std):
                levels += [f"{each:.2f}" for each in figure(quarters, axis=(1, 3, 4)).ravel()]
    return " ".join(levels)


def _same(known: str | None, now: str | None) -> bool:
    """Whether two entries of a row's code are the same: digests, or levels of drawn ground."""
    if known is None or now is None or not (" " in known and " " in now):
        return known == now
    levels, levels_now = known.split(), now.split()
    return len(levels) == len(levels_now) and all(
        abs(float(level) - float(level_now)) <= SAME_GREY
        for level, level_now in zip(levels, levels_now, strict=True)
    )


@lru_cache
def _digest(path: Path) -> str:
    """Short digest of a file, of a source file without its comments and docstrings."""
    if path.suffix != ".py":
        return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):  # so it has this attribute, which mypy does not see
            node.body = [each for each in body if not _is_text(each)] or [ast.Pass()]  # type: ignore[attr-defined]
    return hashlib.sha256(ast.unparse(tree).encode()).hexdigest()[:12]


def _is_text(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def code_of(method: Method | None, scene: str) -> dict[str, str]:
    """The same of a method on a scene; None: of the baselines."""
    generated = column(scene) in TABLE_1
    if method is None:
        return code(BASELINES, "", registration=False, generated=generated)
    return code(method.family, method.edges, registration=method.registration, generated=generated)


def code_of_field(flown: Iterable[Method], scene: str) -> dict[str, str]:
    """The same of the section on the field today, where maps of these rows were flown."""
    generated = column(scene) in TABLE_1
    made = code(FIELD, "", registration=False, generated=generated)
    for each in flown:
        made |= code_of(each, scene)
    return made


def older(row: Result) -> list[str]:
    """What has changed since a row was made: files, "recipe" or "setting"; empty if it is current.

    A file that has gone, or that the row does not know, has changed.
    """
    plain = row.plain
    made = Method(**plain["method"]) if row.family else None
    known, now = plain.get("code", {}), code_of(made, row.scene)
    if FIELD in plain:
        now = code_of_field((Method(**each) for each in plain["methods"]), row.scene)
    paths = known.keys() | now
    changed = sorted(path for path in paths if not _same(known.get(path), now.get(path)))
    setting = SETTINGS[plain["setting"]["name"]]
    families = {each["family"] for each in plain.get("methods", ())} | {row.family}
    today = json.loads(json.dumps(asdict(setting)))
    if _relevant(plain["setting"], families) != _relevant(today, families):
        changed.append("setting")
    if made is not None:
        rows = methods(setting, row.scene, plain["tiles"], sam_weights="PATH")
        if _plain(made.recipe) not in {
            _plain(each.recipe) for each in rows if each.key == made.key
        }:
            changed.append("recipe")
    return changed


def _relevant(setting: dict[str, Any], families: set[str]) -> dict[str, Any]:
    """What of a setting decides the figures of rows of these families."""
    others = [part for part, users in PART_OF.items() if not families & set(users)]
    return {name: value for name, value in setting.items() if not name.startswith(tuple(others))}


def _plain(recipe: str) -> str:
    """A recipe without its epochs, of which more may be learnt."""
    return re.sub(r",(tuning_)?epochs=\d+", "", recipe)


def expected() -> list[str]:
    """Names of all rows of the reduced setting, as files are named."""
    scenes = (*TABLE_1, *REDUCED_REAL, *UNTUNED)
    names = [f"{scene}-{each.key}" for scene in scenes for each in methods(REDUCED, scene, 1000)]
    return [*names, f"B-{BASELINES}", *(f"{scene}-{FIELD}" for scene in FIELD_SCENES)]


def stored() -> list[Result]:
    """All rows in the repository."""
    return [row for name in SETTINGS for row in read(ROWS / name)]


def tried() -> list[Result]:
    """Rows of trainings from which the reduced setting was chosen, and of longer ones."""
    return read(ROWS / TRIED)


def keep(results: Path, setting: str, name: str | None = None) -> list[str]:
    """Copy the results of a setting into the repository; the names of the rows that changed.

    With a name they are kept as rows of another training, beside those of the setting.
    """
    changed = []
    for path in sorted((results / setting).glob("*.json")):
        target = ROWS / setting / path.name
        if name is not None:
            target = ROWS / TRIED / f"{path.stem}-{name}.json"
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


def name_of(row: Result) -> str:
    """Scene and method of a row, as its file is named."""
    if not row.family:
        return f"{row.scene}-{FIELD if FIELD in row.plain else BASELINES}"
    return f"{row.scene}-{Method(**row.plain['method']).key}"


def made_at(row: Result) -> str:
    """Commit and day of a row, "changed" where files were not committed."""
    made = row.plain["provenance"]
    changed = ", changed" if made["dirty"] else ""
    return f"commit {str(made['commit'])[:10]}{changed}, {str(made['date'])[:10]}"
