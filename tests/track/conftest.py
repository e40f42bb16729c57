"""Lets tests of tracks use the known ground of `tests/localize/blots.py`."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "localize"))
