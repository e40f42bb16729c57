"""What tests of reports share: most of the time of a report is drawing."""

import pytest

CALIBRATION = ("calibration_plots.png", "calibration_plots.figure_png")


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of few pixels, which is fast."""
    monkeypatch.setattr("orthonav.evaluate.canvas.DPI", 20)


@pytest.fixture
def no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of accuracy are not drawn."""
    monkeypatch.setattr("orthonav.evaluate.plots.png", lambda *_: b"")


@pytest.fixture
def only_new(monkeypatch: pytest.MonkeyPatch, coarse: None, no_plots: None) -> None:
    """Only pictures of tracks and of worst views are drawn."""
    for name in CALIBRATION:
        monkeypatch.setattr(f"orthonav.evaluate.{name}", lambda *_: b"")
