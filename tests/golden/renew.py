"""Renew the golden views: `python tests/golden/renew.py`, or `make golden`.

Prints what differs from the stored views. Give the reason in the commit.
"""

import json
import os
import tempfile
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import cv2
import golden_views


def main() -> None:
    """Locate the views and store the results."""
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        found = {name: golden_views.located(name, Path(folder)) for name in golden_views.FLIGHTS}
    if golden_views.FILE.exists():
        stored = json.loads(golden_views.FILE.read_text(encoding="utf-8"))
        print(golden_views.report(stored, found) or "no differences")
    flights = []
    for name, rows in found.items():
        lines = ",\n".join(f"  {json.dumps(row)}" for row in rows)
        flights.append(f" {json.dumps(name)}: [\n{lines}\n ]")
    kind = json.dumps(golden_views.instructions())
    text = f'{{\n"instructions": {kind},\n"flights": {{\n' + ",\n".join(flights) + "\n}\n}\n"
    golden_views.FILE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
