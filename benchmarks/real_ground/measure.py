"""Measures rows side by side; functions that other processes call lie here."""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2

from benchmarks.real_ground import gate, pairs
from benchmarks.real_ground.maps import Map, code
from benchmarks.real_ground.rows import PARTS, Question, questions
from benchmarks.real_ground.score import HEADER, RISK, Source, cells
from benchmarks.record import Section, Table, resumed, rows_path, say, side_by_side
from benchmarks.scenes import DATA, FAR_M
from orthonav.core.records import CONFIDENT, RADIUS_SHARE

QUICK_VIEWS = 4
Views = dict[str, int]


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--part", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="rows whose name has this")
    parser.add_argument("--views", type=int, default=40, help="single views per row; tracks longer")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--gate", action="store_true", help="compare the compact part")
    parser.add_argument("--renew", action="store_true", help="with --gate: write its figures")


def measure(options: argparse.Namespace) -> Section:
    if options.gate and not DATA.is_dir():
        print(f"gate of real ground skipped: the optional real imagery is absent ({DATA})")
        return Section("Gate of real ground: skipped")
    figures = gate.figures() if options.gate else {}
    asked = [each for each in questions() if _is_asked(each, options, figures)]
    default = QUICK_VIEWS if options.quick else options.views
    views = {each.name: int(figures.get(each.name, {}).get("views", default)) for each in asked}
    prepare(asked, views, options.work, options.workers)
    tasks = {
        f"{each.name} {views[each.name]}": (each.name, views[each.name], options.work)
        for each in asked
    }
    rows, values = [], {}
    for each, found in zip(asked, _measured(tasks, options), strict=True):
        values[each.name] = found
        rows.append(cells(each.name, found))
        say("  ".join(rows[-1]))
    tables = [Table("Real ground", HEADER, rows, NOTES)] if rows else []
    if found := pairs.paired(values):
        tables.append(pairs.table(found))
    if not options.gate:
        return gate.verdict("Real ground", pairs.failures(found), tables)
    if options.only or set(options.part) < set(PARTS):
        figures = {name: each for name, each in figures.items() if name in values}
    if options.renew:
        gate.write(gate.renewed(gate.figures(), values))
        return Section("Gate of real ground, renewed", tables)
    return gate.judged(figures, values, tables)


NOTES = (
    f"median to NEES median are of confident fixes (confidence of {CONFIDENT:g} or more); of "
    f"right: confident share of the fixes within {FAR_M:g} m or {RADIUS_SHARE:.1%} of the height; "
    "false: confident and beyond both; NEES: 2 in the mean and 1.4 in the median if the covariance "
    f"is right, the truth's own error included; PL exceeded: protection levels at {RISK:g}, of "
    "those that are finite; ms: processor time",
    "rendered views: heading off by 10 deg and height by 10 % (standard deviations, reported); "
    "tilt reported 0, without a deviation unless stated; whole map, no prior",
)


def _is_asked(each: Question, options: argparse.Namespace, figures: dict[str, Any]) -> bool:
    named = not options.only or any(text in each.name for text in options.only)
    return named and each.part in options.part and (not options.gate or each.name in figures)


def _measured(
    tasks: dict[str, tuple[str, int, Path]], options: argparse.Namespace
) -> Iterable[dict[str, Any]]:
    """Values of rows, in order; a gate never takes those of a run before."""
    if options.gate:
        return side_by_side(measured, list(tasks.values()), options.workers)
    stored = rows_path(options.work, f"rows-{code()}")
    return resumed(stored, measured, tasks, options.workers)


def measured(task: tuple[str, int, Path]) -> dict[str, Any]:
    """Values of one row."""
    name, views, work = task
    cv2.setNumThreads(1)
    question = next(each for each in questions() if each.name == name)
    return question.measured(work, views).values()


def prepare(asked: list[Question], views: Views, work: Path, workers: int) -> None:
    """Build maps and render pictures that several rows share, each once."""
    legs = [(*leg, each.of_each(views[each.name])) for each in asked for leg in each.legs]
    maps = dict.fromkeys(built for built, _, _ in legs)
    say(f"{len(maps)} maps")
    for _ in side_by_side(built_in, [(built, work) for built in maps], workers):
        pass
    shared: dict[tuple[str, str], tuple[Map, Source, int, Path]] = {}
    for built, source, count in legs:
        key = built.ortho, source.pictures()
        if source.pictures() and (key not in shared or shared[key][2] < count):
            shared[key] = built, source, count, work
    say(f"{len(shared)} sets of pictures")
    for _ in side_by_side(prepared, list(shared.values()), workers):
        pass


def built_in(task: tuple[Map, Path]) -> None:
    built, work = task
    cv2.setNumThreads(1)
    built.build(work)


def prepared(task: tuple[Map, Source, int, Path]) -> None:
    built, source, count, work = task
    cv2.setNumThreads(1)
    for _ in source.seen(work, built.localizer(work), count, True):
        pass
