"""What `check` says on stderr while it runs without a terminal."""

import time

from orthonav.cli.check import _Lines


def test_a_long_check_says_soon_how_long_it_will_take(capsys, monkeypatch):
    """One of 1,000 s: the first line comes within 40 s, then one every 10 s, none at the end."""
    now_s = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    lines, said = _Lines(), []
    for now_s in range(1001):
        lines("trials", now_s / 1000)
        said += [(now_s, line) for line in capsys.readouterr().err.splitlines()]
    assert said[0] == (30, "trials: 3 %, about 970 s left")
    assert [at_s for at_s, _ in said] == list(range(30, 1000, 10))


def test_a_check_of_seconds_says_nothing(capsys, monkeypatch):
    now_s = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    lines = _Lines()
    for now_s in range(4):
        lines("trials", now_s / 3)
    assert not capsys.readouterr().err
