"""`gnss.csv`: what is written is read, and broken files are named."""

import pytest

from orthonav.core.errors import FlightError
from orthonav.core.flight.gnss import GnssSample, read_gnss, write_gnss

S = 10**9
FULL = GnssSample(9 * S, 10 * S, 48.1, 2.2, 3, 1.5, (3.0, -4.0), 12, 9 * S, 1)
HEAD = "time_s,lat_deg,lon_deg,fix_type\n"


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "gnss.csv"
    bare = GnssSample(11 * S, 11 * S, 48.1, 2.2, 1)
    write_gnss(path, [FULL, bare])
    read = read_gnss(path)
    assert read[0] == FULL
    assert (read[1].fix_type, read[1].has_fix, read[1].vel_en_mps) == (1, False, None)
    assert read[1].satellites == -1 and read[1].stamp_ns is None and read[1].time_ns == 11 * S


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + "x,48,2,3\n", "line 2: time_s or fix_type"),
        (HEAD + "1,48,2,\n", "line 2: time_s or fix_type"),
        (HEAD + "1,98,2,3\n", "line 2: not a latitude"),
        ("time_s,lat_deg\n", "columns are missing: lon_deg, fix_type"),
    ],
)
def test_broken_files_are_named(tmp_path, text, message):
    path = tmp_path / "gnss.csv"
    path.write_text(text)
    with pytest.raises(FlightError, match=message):
        read_gnss(path)
