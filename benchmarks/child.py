"""The measured processes. They import only the code that they measure."""

import importlib
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def memory_mb(kind: str) -> float:
    """Resident memory of this process in MB: the largest (`VmHWM`), now (`VmRSS`), of files now
    (`RssFile`).

    Linux's own count: `ru_maxrss` of a started process also remembers its parent's memory.
    """
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{kind}:"):
            return int(line.split()[1]) * 1024 / 1e6
    raise RuntimeError(f"this system does not report {kind} of a process")


def peak_memory_mb() -> float:
    """Peak resident memory of this process in MB."""
    return memory_mb("VmHWM")


class _Clock:
    """Adds up the time spent inside a function."""

    def __init__(self) -> None:
        self.total_s = 0.0

    def around(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.total_s += time.perf_counter() - start

        return timed


def build(ortho: Path, out: Path) -> None:
    """Build a map with one worker, so that times add up, and print where its time went."""
    start = time.perf_counter()
    from unittest.mock import patch

    from orthonav.core.mapfile import open_map
    from orthonav.core.tiles.gradients import OrientedGradients
    from orthonav.ground.build import BuildRequest, build_map
    from orthonav.ground.imagery.mosaic import Mosaic, SheetRaster

    read, represent, opened = _Clock(), _Clock(), _Clock()
    marks: dict[str, float] = {}

    def progress(stage: str, share: float) -> None:
        now = time.perf_counter()
        if stage == "learn" and share == 0:
            marks.update(learn=now, represent_s=represent.total_s)
        marks[f"{stage} first" if f"{stage} first" not in marks else f"{stage} last"] = now

    with (
        patch.object(SheetRaster, "read_grey", read.around(SheetRaster.read_grey)),
        patch.object(OrientedGradients, "__call__", represent.around(OrientedGradients.__call__)),
        patch.object(Mosaic, "open", opened.around(Mosaic.open)),
    ):
        begun = time.perf_counter()
        result = build_map(BuildRequest([ortho], out, workers=1), progress)
        ended = time.perf_counter()
    registered = "calibrate registration last"
    if registered not in marks:
        registered = "calibrate last"
    # The first crop's share of the calibration (a few ms) is counted as embedding.
    account = {
        "start": begun - start + opened.total_s,
        "read": read.total_s,
        "represent": marks["represent_s"],
        "learn": marks["learn last"] - marks["learn"],
        "embed": marks["calibrate first"] - marks["learn last"],
        "calibrate": marks["calibrate last"] - marks["calibrate first"],
        "register": marks[registered] - marks["calibrate last"],
        "write": ended - marks[registered],
        "cells": marks["learn"] - begun - opened.total_s - read.total_s - marks["represent_s"],
    }
    sheet = result.manifest.sheets[0]
    arrays = open_map(out).arrays
    basis = arrays["embed/basis"]
    layer = [array.nbytes for name, array in arrays.items() if name.startswith("sheet0/grey/")]
    source = result.manifest.imagery[0]
    account |= {
        "km2": sheet.area_km2,
        "tiles": sheet.tiles,
        "features": basis.shape[0],
        "dims": basis.shape[1],
        "map_bytes": result.size_bytes,
        "layer_bytes": sum(layer),
        "decoded_bytes": 3 * source["width_px"] * source["height_px"],
        "peak_mb": peak_memory_mb(),
        "inside_s": time.perf_counter() - start,
    }
    print(json.dumps(account))


def run(arguments: list[str]) -> int:
    """Run the command line here, or without arguments only load what flies, and print the peak."""
    if arguments:
        from orthonav.cli import main

        code = main(arguments)
    else:
        importlib.import_module("cv2")  # imports NumPy too
        code = 0
    print(json.dumps(peak_memory_mb()))
    return code


if __name__ == "__main__":
    if sys.argv[1] == "build":
        build(Path(sys.argv[2]), Path(sys.argv[3]))
    else:
        sys.exit(run(sys.argv[2:]))
