"""What tests of reports share: most of the time of a report is drawing."""

import pytest

from orthonav.ground.report import Drawing

CALIBRATION = ("calibration_plots.draw_axes", "calibration_plots.draw_figure")
NOTHING = Drawing(b"", "", (1.0, 1.0))


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of few pixels, which is fast."""
    monkeypatch.setattr("orthonav.ground.report.canvas.DPI", 20)


@pytest.fixture
def no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of accuracy are not drawn."""
    monkeypatch.setattr("orthonav.ground.evaluate.plots.draw_axes", lambda *_: NOTHING)


@pytest.fixture
def no_calibration_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of confidence and covariance are not drawn."""
    for name in CALIBRATION:
        monkeypatch.setattr(f"orthonav.ground.evaluate.{name}", lambda *_: NOTHING)


@pytest.fixture
def only_new(coarse: None, no_plots: None, no_calibration_plots: None) -> None:
    """Only pictures of tracks and of worst views are drawn."""
