"""`orthonav view`: a run in the browser."""

import argparse
import logging
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from orthonav.ground.view.server import Server

log = logging.getLogger(__name__)
EVERYDAY = ("--flight", "--truth", "--live")
LOOPBACK = "127.0.0.1"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "run",
        type=Path,
        metavar="RUN",
        help="fixes.jsonl, the output of `orthonav fly --jsonl`, or a flight log (file, folder, or "
        "the name given to --log)",
    )
    parser.add_argument(
        "second",
        type=Path,
        nargs="?",
        metavar="SECOND",
        help="another run of the same flight to compare, such as single and tracked fixes",
    )
    parser.add_argument(
        "--map", type=Path, required=True, metavar="MAP.onav", help="map of the flight"
    )
    parser.add_argument(
        "--flight",
        type=Path,
        metavar="FLIGHT_DIR",
        help="flight folder or flight log with the images (not needed if RUN is a log)",
    )
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="truth.csv",
        help="ground truth: the true positions (default: those of the flight folder, if any)",
    )
    parser.add_argument(
        "--mount",
        type=Path,
        metavar="mount.json",
        help="calibration by `orthonav calibrate` with which the flight was localized (default: "
        "that of the flight log, if RUN is one)",
    )
    parser.add_argument(
        "--radius-m", type=float, default=15.0, help="largest error of a correct fix (default 15)"
    )
    parser.add_argument(
        "--live",
        action="store_true",
        help="the run is in progress: show new views as they arrive; the file need not exist yet",
    )
    parser.add_argument(
        "--port", type=_port, default=0, help="port of the server (default: any free port)"
    )
    parser.add_argument(
        "--host",
        default=LOOPBACK,
        help=f"address to listen on (default {LOOPBACK}: this computer only)",
    )
    parser.add_argument(
        "--no-browser", action="store_true", help="print the address without opening a browser"
    )


def run(options: argparse.Namespace) -> None:
    from orthonav.ground.view.run import ViewRequest, open_run
    from orthonav.ground.view.server import Pages, Server, load_assets

    request = ViewRequest(
        run=options.run,
        second=options.second,
        map_path=options.map,
        flight=options.flight,
        truth=options.truth,
        mount=options.mount,
        radius_m=options.radius_m,
        live=options.live,
    )
    assets = load_assets()
    server = Server(Pages(open_run(request), assets), options.host, options.port)
    with server:
        _announce(server, options)
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            print("ended", flush=True)


def _announce(server: "Server", options: argparse.Namespace) -> None:
    if not server.only_loopback:
        log.warning(
            "listening at %s: anyone who can reach this computer over the network can see this run",
            options.host,
        )
    address = server.url()
    print(f"{address}  (Ctrl-C ends)", flush=True)
    # Without a screen a text browser would cover the output.
    screen = not sys.platform.startswith("linux") or {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}
    if not options.no_browser and sys.stdout.isatty() and screen:
        import threading
        import webbrowser

        # Some browsers return only when closed.
        threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()


def _port(text: str) -> int:
    port = int(text)
    if not 0 <= port <= 65535:
        raise argparse.ArgumentTypeError(f"a port must be 0 to 65535, got {text}")
    return port
