"""Leaves out pictures that do not exist, such as those that need a browser.

`tools/docs/pictures.py` makes all pictures; these few it may do without. A page that shows any
other picture that is not there does not build.
"""

import re
from pathlib import Path
from typing import Any

OPTIONAL = ("view.png", "check.png")
LINE = re.compile(r"^!\[[^\]]*\]\([^)]*pictures/([\w.-]+)\)\n", re.MULTILINE)


def setup(app: Any) -> dict[str, bool]:
    """Connect the extension to Sphinx."""
    app.connect("source-read", _leave_out)
    return {"parallel_read_safe": True}


def _leave_out(app: Any, _docname: str, source: list[str]) -> None:
    folder = Path(app.srcdir) / "pictures"

    def replaced(found: re.Match[str]) -> str:
        is_missing = found[1] in OPTIONAL and not (folder / found[1]).is_file()
        return "" if is_missing else found[0]

    source[0] = LINE.sub(replaced, source[0])
