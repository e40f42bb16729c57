"""`orthonav view`: a run in the browser."""

import argparse
import logging
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from orthonav.web.server import Server

log = logging.getLogger(__name__)
LOOPBACK = "127.0.0.1"


def add(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "run",
        type=Path,
        metavar="RUN",
        help="fixes.jsonl, what `orthonav fly --jsonl` writes, or a flight log (a file, its "
        "folder, or the name given to --log)",
    )
    parser.add_argument("--map", type=Path, required=True, metavar="MAP.onav")
    parser.add_argument(
        "--flight",
        type=Path,
        metavar="FLIGHT_DIR",
        help="pictures of the views: a flight folder or a flight log (a log as RUN brings its own)",
    )
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="truth.csv",
        help="true positions (default: those of the flight folder, where it has any)",
    )
    parser.add_argument(
        "--radius-m", type=float, default=15.0, help="an error below it is right (default 15)"
    )
    parser.add_argument(
        "--live",
        action="store_true",
        help="the run is being flown: show what comes as it comes; its file may still be to come",
    )
    parser.add_argument("--port", type=_port, default=0, help="default: any that is free")
    parser.add_argument(
        "--host",
        default=LOOPBACK,
        help=f"address to listen at (default {LOOPBACK}: nobody else can reach it)",
    )
    parser.add_argument(
        "--no-browser", action="store_true", help="only print the address, open no browser"
    )


def run(options: argparse.Namespace) -> None:
    """Read the run, serve it until interrupted."""
    from orthonav.web.assets import load_assets
    from orthonav.web.opening import ViewRequest, open_run
    from orthonav.web.server import Pages, Server

    request = ViewRequest(
        run=options.run,
        map_path=options.map,
        flight=options.flight,
        truth=options.truth,
        radius_m=options.radius_m,
        live=options.live,
    )
    assets = load_assets()
    server = Server(Pages(open_run(request), assets), options.host, options.port)
    with server:
        _tell(server, options)
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            print("ended", flush=True)


def _tell(server: "Server", options: argparse.Namespace) -> None:
    """Print the address, and open it where somebody sits at this computer."""
    if not server.only_loopback:
        log.warning(
            "listening at %s: whoever reaches this computer over the network can look at this run",
            options.host,
        )
    address = server.url()
    print(f"{address}  (Ctrl-C ends)", flush=True)
    if not options.no_browser and sys.stdout.isatty() and _has_screen():
        import threading
        import webbrowser

        # Some browsers return only when they are closed.
        threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()


def _has_screen() -> bool:
    """Whether a window can be opened; in a terminal a browser would cover what is printed."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _port(text: str) -> int:
    port = int(text)
    if not 0 <= port <= 65535:
        raise argparse.ArgumentTypeError(f"a port is 0 to 65535, got {text}")
    return port
