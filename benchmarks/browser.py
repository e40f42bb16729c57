"""A Chromium of this machine, for measurements and tests of the page of `orthonav view`.

`python -m benchmarks.browser` says which it is; exit 1 where there is none.
"""

import functools
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
HOW_TO_GET_ONE = (
    "no Chromium was found: run .venv/bin/playwright install chromium or apt install chromium, "
    "or name one in ORTHONAV_CHROMIUM"
)


@functools.cache
def chromium() -> Path | None:
    """The one named in ORTHONAV_CHROMIUM, else one on the PATH, else Playwright's own."""
    named = os.environ.get("ORTHONAV_CHROMIUM")
    if named:
        return Path(named)  # where it does not start, that is to be seen
    for found in filter(None, map(shutil.which, NAMES)):
        if version_of(Path(found)):
            return Path(found)
    with sync_playwright() as playwright:
        own = Path(playwright.chromium.executable_path)
    return own if version_of(own) else None


def version_of(path: Path) -> str:
    """Version string of the browser; empty if it does not start, as with package stubs."""
    try:
        done = subprocess.run(
            [path, "--version"], capture_output=True, text=True, timeout=60, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()


@contextmanager
def started() -> Iterator[Browser]:
    """That Chromium, without a window; raises `FileNotFoundError` where there is none."""
    path = chromium()
    if path is None:
        raise FileNotFoundError(HOW_TO_GET_ONE)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path)
        try:
            yield browser
        finally:
            browser.close()


def main() -> int:
    path = chromium()
    if path is None:
        print(f"the page is not tested in a browser: {HOW_TO_GET_ONE}")
        return 1
    print(f"the page is tested in {path} ({version_of(path) or 'does not start'})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
