"""`tools/constants.py`: numbers are found and changed one at a time, and moves are counted."""

import math

from tools import constants

SOURCE = '''"""A module."""
from dataclasses import dataclass

STEPS = 2
RATE, NAME = 0.5, "half"

@dataclass
class Limits:
    most_m: float = 3.0 * 10
    none: int = 0
'''


def changed(monkeypatch, tmp_path, name, factor):
    """The names of the module where one number of it is changed."""
    monkeypatch.setattr(constants, "SOURCES", tmp_path / "package")
    path = tmp_path / "package" / "module.py"
    path.parent.mkdir(exist_ok=True)
    path.write_text(SOURCE, encoding="utf-8")
    number = {each.name: each for each in constants.numbers_of(path)}[name]
    finder = constants._Finder(number, factor)
    spec = finder.find_spec("package.module")
    names = {}
    exec(spec.loader.get_code("package.module"), names)
    return names


def test_each_number_is_changed_alone(monkeypatch, tmp_path):
    up = changed(monkeypatch, tmp_path, "STEPS", 1.3)
    assert (up["STEPS"], up["RATE"], up["NAME"]) == (3, 0.5, "half")
    down = changed(monkeypatch, tmp_path, "(RATE, NAME)", 0.7)
    assert (down["STEPS"], down["RATE"]) == (2, 0.35)


def test_fields_of_records_are_numbers_too(monkeypatch, tmp_path):
    names = changed(monkeypatch, tmp_path, "Limits.most_m", 0.7)
    assert names["Limits"]().most_m == 3.0 * 0.7 * 10
    assert "Limits.none" not in {
        each.name for each in constants.numbers_of(tmp_path / "package" / "module.py")
    }


def test_moves_are_counted():
    before = {"flight": [{"east_m": 0.0, "north_m": 0.0}, {"reason": "no place"}]}
    after = {"flight": [{"east_m": 3.0, "north_m": 4.0}, {"reason": "no place"}]}
    assert constants.moved(before, before) == (0, 0.0)
    assert constants.moved(before, after) == (1, 5.0)
    assert constants.moved(before, "ValueError: endless") == (2, math.inf)
