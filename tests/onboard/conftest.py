"""Lets tests of flights use the known ground of `tests/localize/blots.py`, and recorded bags of
`tests/recordings/bags.py`."""

import sys
from pathlib import Path

for folder in ("localize", "recordings"):
    sys.path.append(str(Path(__file__).parents[1] / folder))
