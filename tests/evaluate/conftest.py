"""What tests of reports share: most of the time of a report is drawing."""

import pytest

from orthonav.ground.report.drawing import Drawing


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of few pixels, which is fast."""
    monkeypatch.setattr("orthonav.ground.report.drawing.DPI", 20)


@pytest.fixture
def no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is drawn."""
    monkeypatch.setattr("orthonav.ground.report.drawing.DPI", 20)
    for name in ("draw_axes", "draw_figure"):
        monkeypatch.setattr(
            f"orthonav.ground.evaluate.report.{name}", lambda *_: Drawing(b"", "", (1.0, 1.0))
        )
