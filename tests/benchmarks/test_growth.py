"""Blocks of sheets, curves of growth, memory of a process, instructions of a view."""

import numpy as np
import pytest
from arm64 import instructions
from benchmarks.child import memory_mb

from benchmarks import growth, growth_sheets
from orthonav.ground.planning.sheets import WorldSheets


@pytest.mark.parametrize("side", [1, 2, 4])
def test_a_block_holds_the_sheets_of_so_many_rows(side):
    world = WorldSheets(1500.0)
    first = world.bounds_deg(world.name_at(46.5, 3.0))
    names = list(world.over(growth_sheets.block(first, side)))
    assert world.name_at(46.5, 3.0) in names
    assert len({name[:7] for name in names}) == side
    assert side**2 <= len(names) <= side * (side + 1)


def test_the_first_sheet_lies_within_the_imagery(make_ortho, tmp_path):
    ortho = make_ortho(tmp_path / "a.tif", np.zeros((600, 600), np.uint8), gsd_m=8.0)
    west, south, east, north = growth_sheets.first_sheet(ortho)
    outline = growth_sheets.Mosaic.open([ortho]).outline_latlon_deg
    assert outline[:, 0].min() < south < north < outline[:, 0].max()
    assert outline[:, 1].min() < west < east < outline[:, 1].max()


def test_a_curve_names_the_exponent_of_its_first_figure():
    curve = growth.Curve("sheets", [1.0, 4.0, 16.0], [(2.0, 9.0), (4.0, 9.0), (8.0, 9.0)])
    assert curve.slope == pytest.approx(0.5)
    assert curve.notes("time") == ("time grows as x^0.50",)
    assert growth.Curve("sheets", [1.0], [(2.0, 9.0)]).notes("time") == ()


def test_the_memory_of_files_is_part_of_the_resident_memory():
    files, now, peak = (memory_mb(kind) for kind in ("RssFile", "VmRSS", "VmHWM"))
    assert 0 < files < now <= peak
    with pytest.raises(RuntimeError, match="Vm0"):
        memory_mb("Vm0")


def test_instructions_of_a_view_leave_out_the_start():
    seen = []

    def counted(processor, run, views):
        seen.append((run, views))
        return 1e9 + 7e6 * views

    assert instructions._per_view(counted, None, "track", 9) == pytest.approx(7e6)
    assert seen == [("track", 9), ("track", 18)]


def test_the_estimate_is_instructions_by_those_of_a_second():
    name, run, millions, ratio, *estimates = instructions.row("A76", "views", 4.8e9, 2.4e9)
    assert (name, run, millions, ratio) == ("A76", "views", "4,800", "2.00")
    assert estimates == ["2000", "1000"]


@pytest.mark.parametrize(
    ("printed", "count"),
    [("x\ninstructions: 12345\n", "12345"), ("==27706== I   refs:      2,851,113\n", "2,851,113")],
)
def test_both_counters_are_read(printed, count):
    assert instructions.COUNTED.findall(printed) == [count]
