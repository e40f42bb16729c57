"""`orthonav view`: a run in the browser."""

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from orthonav.cli.common import add_options, given, within
from orthonav.cli.source import add_source, source_options

if TYPE_CHECKING:
    from orthonav.ground.view.server import Server

EXAMPLE = "fixes.jsonl --map area.onav --flight flight"
EVERYDAY = ("--flight", "--truth")


def add(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    text = "fixes.jsonl, the output of `orthonav fly --jsonl`, or a flight log (file, folder, or "
    add("run", type=Path, metavar="RUN", help=f"{text}the name given to --log)")
    text = "another run of the same flight to compare, such as single and tracked fixes"
    add("second", type=Path, nargs="?", metavar="SECOND", help=text)
    add("--map", type=Path, required=True, metavar="MAP.onav", help="map of the flight")
    text = "images: flight folder, photographs or flight log (not needed if RUN is a log)"
    add("--flight", type=Path, metavar="FLIGHT_DIR", help=text)
    text = "ground truth: the true positions (default: those that --flight has, if any)"
    add("--truth", type=Path, metavar="truth.csv", help=text)
    add_options(parser, "--mount", "--radius-m")
    port, text = within(0, 65535, int), "port of the server (default: any free port)"
    add("--port", type=port, default=0, metavar="N", help=text)
    add_source(parser, dem=False)


def run(options: argparse.Namespace) -> None:
    from orthonav.ground.view.run import Run, ViewRequest
    from orthonav.ground.view.server import Pages, Server, load_assets

    source = source_options(options, skip_bad_images=True)
    request = ViewRequest(**given(options, ViewRequest), map_path=options.map, source=source)
    pages = Pages(Run(request), load_assets())
    server = Server(pages, options.port)
    with server:
        _announce(server)
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            print("ended", flush=True)


def _announce(server: "Server") -> None:
    address = server.url()
    print(f"{address}  (Ctrl-C ends)", flush=True)
    # Without a screen a text browser would cover the output.
    screen = not sys.platform.startswith("linux") or {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}
    if sys.stdout.isatty() and screen:
        import threading
        import webbrowser

        # Some browsers return only when closed.
        threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
