"""Lets tests of flights use the known ground of `tests/localizer/blots.py`, and recorded bags of
`tests/recordings/bags.py`."""

import sys
from pathlib import Path

for folder in ("localizer", "recordings"):
    sys.path.append(str(Path(__file__).parents[1] / folder))
