"""`python -m experiments.paper`: run the paper's experiments; `report`: tables of them.

Every run leaves one file under `paper_results/<setting>/` and is not run again while it is there.
`pictures` compares the two dates of each scene. `keep` copies these files into the repository and
makes `docs/paper-results.md` of what is there.
"""

import argparse
import logging
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.record import say
from benchmarks.scenes import DATA

from experiments.paper import curves, dates, field, matchers, runs, scenes, tables
from experiments.paper.methods import (
    BETWEEN_DATES,
    FIELD_SCENES,
    GPU_SCENES,
    SETTINGS,
    STUDIED,
    TABLE_1,
    Setting,
    dry,
    flown,
    methods,
)
from experiments.paper.results import BASELINES, FIELD, PROGRAM, keep, stored
from experiments.paper.scenes import Scene
from orthonav.core.cores import usable_cores
from orthonav.core.errors import MissingExtraError, OrthonavError
from orthonav.core.extras import require
from orthonav.core.tiles.learned import VARIABLE

PARTS = ("A", "B", "C", "D", "real", "untuned", "own", BASELINES, FIELD)
PICTURES = f"{PROGRAM} pictures"
PICTURED = (*TABLE_1, "real", "untuned")
PARTS_OF = {"gpu": GPU_SCENES, "epochs": (STUDIED,)}
ORDER = ("triplet", "caevl", "autoencoder", "gradient", "bovw")


def main(arguments: list[str]) -> int:
    """Run the chosen parts, then report; returns the exit code."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.ERROR, format="%(levelname)s: %(message)s")
    if options.what == "keep":
        for name in keep(options.out, options.setting):
            say(f"stored: {name}")
        tables.PAGE.write_text(tables.page(stored()), encoding="utf-8")
        curves.figure(stored(), curves.FIGURE)
        return 0
    if options.what == "pictures":
        place = runs.Workplace(options.out, SETTINGS[options.setting], PICTURES)
        dates.run(place, _scenes(options, place.setting, set(options.only or PICTURED)))
        say(f"written to {options.out}")
        return 0
    failed = 0
    if options.what == "run":
        shown = [Path(each).name if "/" in each else each for each in arguments]
        failed = _run(options, " ".join([PROGRAM, *shown]))
    folder = f"dry-{options.setting}" if options.dry_run else options.setting
    made = tables.report(options.out, folder)
    if made is None:
        say(f"nothing to report: no results in {options.out / folder}")
        return 1
    print(made.read_text(encoding="utf-8"))
    say(f"written to {made.parent}")
    return 1 if failed else 0


def _run(options: argparse.Namespace, command: str) -> int:
    """Run all rows that are wanted, several at a time; how many failed."""
    learnt = not options.methods or set(options.methods) != {"gradient"}
    require(PROGRAM, "geo", *(["train"] if learnt else []))
    os.environ[VARIABLE] = str(BETWEEN_DATES)  # maps do not say where their network lies
    start = time.perf_counter()
    setting = dry(SETTINGS[options.setting]) if options.dry_run else SETTINGS[options.setting]
    goes_on = setting.name == "epochs"
    keeps = options.keep_checkpoints or goes_on
    place = runs.Workplace(options.out, setting, command, options.device, options.workers, keeps)
    wanted = set(options.only or PARTS_OF.get(setting.name, PARTS))
    if FIELD in wanted and not _has_matchers(options):
        wanted.discard(FIELD)
    tasks = _tasks(options, place, wanted)
    jobs = 1 if goes_on else options.jobs or (usable_cores() if setting.name == "reduced" else 1)
    if jobs > 1:  # those that learn longest first, so that no core is idle at the end
        tasks.sort(key=lambda task: ORDER.index(task[2].family))
    flown_over = {task[1].name: task[1] for task in tasks}.values()
    for scene in flown_over:
        scenes.render(scene)
        say(f"{_minutes(start)}  {scene.name}: imagery is there")
    failed = 0
    for (_, scene, method), minutes in runs.side_by_side(tasks, jobs):
        if not keeps:  # `run` has removed the last one; CAEVL has an earlier one
            for left in place.work(scene, method.key).glob("*/checkpoint.pt"):
                left.unlink()
        status = f"failed: {minutes!r}" if isinstance(minutes, Exception) else f"{minutes} min"
        failed += isinstance(minutes, Exception)
        say(f"{_minutes(start)}  {scene.name} {method.key}: {status}")
    for scene in flown_over:
        tried = scene.name == STUDIED and BASELINES in wanted
        if tried and runs.run_baselines(place, scene):
            say(f"{_minutes(start)}  baselines")
        in_field = FIELD in wanted and scene.name in FIELD_SCENES
        if in_field and field.run(place, scene):
            say(f"{_minutes(start)}  {scene.name}: the field today")
    return failed


def _has_matchers(options: argparse.Namespace) -> bool:
    """Whether local features can be run; raises `MissingExtraError` where they were asked for."""
    try:
        matchers.require_packages()
    except MissingExtraError as error:
        if FIELD in (options.only or ()):
            raise
        say(f"field skipped: {error}")
        return False
    return True


def _tasks(options: argparse.Namespace, place: runs.Workplace, wanted: set[str]) -> list[runs.Task]:
    """All rows of the chosen parts: workplace, scene and method."""
    tasks: list[runs.Task] = []
    for scene in _scenes(options, place.setting, wanted):
        tiles = scene.trajectory.tiles
        rows = methods(place.setting, scene.name, tiles, options.sam, options.epochs)
        chosen = [each for each in rows if not options.methods or each.family in options.methods]
        if not scene.others:
            chosen = [each for each in chosen if not each.needs_dates]
        if not _whole(scene, wanted):
            needed = {runs.MAP_OF} if BASELINES in wanted else set()
            if FIELD in wanted and scene.name in FIELD_SCENES:
                needed |= {each.key for each in flown(chosen)}
            chosen = [each for each in rows if each.key in needed]
        tasks += [(place, scene, method) for method in chosen]
        say(f"           {scene.name}: {tiles:,} tiles, {len(chosen)} runs")
    return tasks


def _whole(scene: Scene, wanted: set[str]) -> bool:
    """Whether all rows of a scene are wanted, not only those that another part needs."""
    parts = dict.fromkeys(scenes.UNTUNED, "untuned") | dict.fromkeys(scenes.REAL, "real")
    part = parts.get(scene.name, scene.name)
    return part in wanted or part not in PARTS


def _minutes(start: float) -> str:
    return f"{(time.perf_counter() - start) / 60:5.1f} min"


def _scenes(options: argparse.Namespace, setting: Setting, wanted: set[str]) -> Iterator[Scene]:
    for name in ("B", "D", "A", "C"):
        if name in wanted or (name == STUDIED and wanted & {BASELINES, FIELD}):
            yield scenes.generated(setting, name, options.out / "areas", options.gsd_m)
    if "own" in wanted and options.past and options.present:
        name = f"own-{options.past.stem}-{options.present.stem}"
        yield scenes.over(name, options.past, options.present, options.gsd_m).of(setting)
    few = scenes.REDUCED_REAL if setting.name == "reduced" else scenes.REAL
    sets = {"real": few, "untuned": scenes.UNTUNED}
    for name in (each for each in sets if wanted & {each, FIELD}):
        found = list(scenes.real(options.data, sets[name]))
        if not found:
            say(f"{name} skipped: the optional real imagery beside the checkout is absent")
        for each in found:
            if name in wanted or each.name in FIELD_SCENES:
                yield each.of(setting)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=PROGRAM, description=__doc__)
    add = parser.add_argument
    add("what", nargs="?", choices=("run", "report", "pictures", "keep"), default="run")
    add("--setting", choices=tuple(SETTINGS), default="reduced")
    add("--only", nargs="+", choices=PARTS, help="only these parts")
    add("--methods", nargs="+", metavar="NAME", help="gradient, bovw, autoencoder, caevl, triplet")
    add("--out", type=Path, default=Path("paper_results"), metavar="DIR")
    add("--data", type=Path, default=DATA, metavar="DIR", help="optional real imagery")
    add("--jobs", type=int, help="runs at a time (default one per core; 1 in the full setting)")
    add("--dry-run", action="store_true", help="every step once, on two tiles of every scene")
    add("--device", default="auto", choices=("auto", "cpu", "cuda"), help="to learn networks")
    add("--workers", type=int, metavar="N", help="threads that make batches and read imagery")
    add("--keep-checkpoints", action="store_true", help="so that epochs can be added")
    add("--epochs", type=int, metavar="N", help="of networks; added to a kept checkpoint")
    add("--past", type=Path, help="an orthophoto of your own, for the map")
    add("--present", type=Path, help="the same ground at another date")
    add("--gsd-m", type=float, help="ground resolution of --past, or of A to D as further scenes")
    add("--sam", metavar="PATH", help="weights of Segment Anything: adds its rows")
    return parser


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except OrthonavError as error:
        sys.exit(f"error: {error}")
