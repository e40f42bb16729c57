"""Tables of untrusted origin: bounded lines, rows and memory; errors name lines."""

import io

import pytest

from helpers import memory_below
from orthonav.core.errors import FlightError, RouteError
from orthonav.core.flight import folder as folders
from orthonav.core.flight.fixes import MAX_LINE_BYTES, read_results
from orthonav.core.flight.folder import read_truth
from orthonav.core.tables import TableError, TableRows
from orthonav.ground.planning.route import read_route
from orthonav.ground.recordings.logs import read_table

TRUTH = "frame,lat_deg,lon_deg\n"
TABLE = "time_s,pitch_deg,roll_deg\n"


def test_rows_are_bounded():
    text = "a\n" + "1\n" * 5
    assert len(list(TableRows(io.StringIO(text), most_rows=5))) == 5
    with pytest.raises(TableError, match="line 6: table has more than 4 rows"):
        list(TableRows(io.StringIO(text), most_rows=4))


@pytest.mark.parametrize("at", [1, 3])
@pytest.mark.parametrize(
    ("name", "head", "row", "read", "error"),
    [
        ("truth.csv", TRUTH, "{},1,2\n", read_truth, FlightError),
        ("table.csv", TABLE, "{},1,2\n", read_table, FlightError),
        ("route.csv", "lat,lon\n", "1,{}\n", read_route, RouteError),
    ],
)
def test_a_line_of_many_fields_is_refused(tmp_path, at, name, head, row, read, error):
    lines = [head, row.format(1), row.format(2)]
    lines[at - 1] = lines[at - 1].rstrip() + "," * 3_000_000 + "\n"
    path = tmp_path / name
    path.write_text("".join(lines))
    refused = pytest.raises(error, match=rf"line {at} is longer than .*{path}")
    with memory_below(10 * path.stat().st_size), refused:
        read(path)


def test_decimal_commas_are_not_taken_for_fields(tmp_path):
    route, truth = tmp_path / "route.csv", tmp_path / "truth.csv"
    route.write_text("lat,lon\n47.1,-99.2,,a note\n47,018,-99,162\n")
    with pytest.raises(RouteError, match="line 3 has more numbers than the header"):
        read_route(route)
    route.write_text("lat,lon,note\n47,2,turn left, 3\n47.1,2,b,2024-05-01\n")
    read_route(route)
    truth.write_text(TRUTH + "0.jpg,47,018,-99,162\n")
    with pytest.raises(FlightError, match="line 2 has more numbers than the header"):
        read_truth(truth)


def test_a_table_may_end_within_its_last_row(tmp_path):
    path = tmp_path / "table.csv"
    rows = ["0,1,2,46.5,2.5", "1,1,2,46.5,2.5", "2,1"]
    path.write_text(TABLE.rstrip() + ",lat_deg,lon_deg\n" + "\n".join(rows))
    assert read_table(path).attitude.time_ns.tolist() == [0, 10**9]
    path.write_text(path.read_text().removesuffix("2,1") + "x,1")
    with pytest.raises(FlightError, match="line 4: time_s is not a time"):
        read_table(path)


def test_tables_of_a_flight_have_at_most_so_many_rows(tmp_path, monkeypatch):
    monkeypatch.setattr(folders, "MAX_VIEWS", 3)
    path = tmp_path / "truth.csv"
    path.write_text(TRUTH + "".join(f"{n},1,2\n" for n in range(3)))
    assert len(read_truth(path)) == 3
    path.write_text(TRUTH + "".join(f"{n},1,2\n" for n in range(4)))
    with pytest.raises(FlightError, match="line 5: table has more than 3 rows"):
        read_truth(path)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", "lat,lon\n" + "0,0\n" * 20_000),
        ("a.waypoints", "QGC WPL 110\n" + "0 0 3 16 0 0 0 0 1 1 1 1\n" * 8_000),
    ],
)
def test_routes_of_too_many_waypoints_take_little_memory(tmp_path, monkeypatch, name, text):
    monkeypatch.setattr("orthonav.ground.planning.record.MAX_WAYPOINTS", 5_000)
    path = tmp_path / name
    path.write_text(text)
    refused = pytest.raises(RouteError, match="at most 5,000 are read")
    with memory_below(5_000_000), refused:  # mostly the 5,000 waypoints
        read_route(path)


def test_a_line_of_fixes_is_bounded(tmp_path):
    path = tmp_path / "fixes.jsonl"
    path.write_bytes(b"\n[" + b" " * MAX_LINE_BYTES + b"]\n")
    with pytest.raises(FlightError, match="line 2: more than 1,048,576 bytes"):
        read_results(path)
