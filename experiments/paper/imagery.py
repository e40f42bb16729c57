"""Rows over generated imagery after a change of the generator: is the imagery still the same?

A row states the SHA-256 of its imagery. Where today's generator makes the very same files, the row
is not older than it, whatever changed in its source.
"""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

from experiments.paper import scenes
from experiments.paper.methods import column
from experiments.paper.results import Result
from experiments.paper.stored import GENERATED, ROOT, ROWS, compact, digest, name_of, older
from experiments.paper.trajectories import SETTINGS, TABLE_1
from orthonav.files import write_text


def renew(folder: Path) -> Iterator[str]:
    """Names of the stored rows whose imagery today's generator makes byte for byte.

    Their digests of the generator become today's. `folder` takes the imagery.
    """
    today = {p.relative_to(ROOT).as_posix() for each in GENERATED for p in ROOT.glob(each)}
    for path in sorted(ROWS.glob("*/*.json")):
        row = Result(json.loads(path.read_text(encoding="utf-8")))
        known = row.plain.get("code", {})
        source = {name for name in known if any(Path(name).match(each) for each in GENERATED)}
        stale = column(row.scene) in TABLE_1 and (today | source) & set(older(row))
        if stale and _imagery(row, folder) == row.plain["inputs"]:
            kept = {name: known[name] for name in known if name not in source}
            now = {name: digest(ROOT / name) for name in today}
            row.plain["code"] = dict(sorted((kept | now).items()))
            write_text(path, compact(row.plain))
            yield name_of(row)


def _imagery(row: Result, folder: Path) -> dict[str, str]:
    """Digests of the imagery of a row as today's generator makes it."""
    setting = SETTINGS[row.plain["setting"]["name"]]
    gsd_m = row.plain["trajectory"]["gsd_m"]
    scene = scenes.generated(setting, column(row.scene), folder, gsd_m)
    scenes.render(scene)
    paths = (scene.past, scene.present, *scene.others)
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
