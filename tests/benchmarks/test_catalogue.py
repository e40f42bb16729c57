"""The catalogue of scenes, rows that resume, memory of a process."""

import json

import pytest
from benchmarks.placing import memory_mb
from benchmarks.record import resumed
from benchmarks.scenes import SCENES, leave_one_out_pairs, place_of


def test_the_catalogue_names_pairs_of_dates():
    first = SCENES["naip"].pair("20090818", "20180716")
    assert (first.name, first.map) == ("naip 20090818 > 20180716", "naip_nd/20090818.tif")
    assert first.gsd_m == 5.0
    generated = next(each for each in leave_one_out_pairs() if each.scene == "generated_31")
    assert generated.map.startswith("generated:31:") and generated.is_there
    assert len({place_of(each) for each in leave_one_out_pairs()}) == 9


def test_an_interrupted_run_makes_the_missing_rows_only(tmp_path):
    made, path = [], tmp_path / "rows.jsonl"
    path.write_text(json.dumps(["a", 10]) + '\n["b", 2')  # killed while it wrote a line

    def square(value):
        made.append(value)
        return value**2

    tasks = {"a": 1, "b": 2, "c": 3}
    assert list(resumed(path, square, tasks)) == [10, 4, 9] and made == [2, 3]
    assert list(resumed(path, square, tasks)) == [10, 4, 9] and made == [2, 3]


def test_the_memory_now_is_at_most_the_peak():
    assert 0 < memory_mb("VmRSS") <= memory_mb()
    with pytest.raises(RuntimeError, match="Vm0"):
        memory_mb("Vm0")
