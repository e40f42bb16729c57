"""The server of the page: read-only, and for this computer only.

There is no password: it listens on the loopback. A web site in the same browser could still try to
reach it, by DNS rebinding, which the check of the Host header refuses, or by cross-site requests,
which the check of Sec-Fetch-Site refuses; responses never allow other origins to read them.
"""

import json
import logging
import re
import socketserver
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import PurePath
from typing import Any

from orthonav.core.errors import FlightError, OrthonavError, OutputError
from orthonav.ground.report.page import leaflet_files
from orthonav.ground.view.run import Run

MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".png": "image/png",
    ".svg": "image/svg+xml",
}
LEAFLET = (
    "leaflet.css",
    "leaflet-src.esm.js",
    "images/layers.png",
    "images/layers-2x.png",
    "images/marker-icon.png",
)
SHARED = ("chart.js", "format.js", "plane.js")
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Response:
    status: HTTPStatus
    data: bytes = b""
    media_type: str = "text/plain; charset=utf-8"
    cache: str = "no-store"


def load_assets() -> dict[str, Response]:
    """All files of the page by the path of their request, `/` for the page itself.

    Only these can be requested: no path is derived from what a browser sends. Raises
    `MissingExtraError` where Leaflet is not installed.
    """
    own: list[Any] = list(files("orthonav.ground.view").joinpath("static").iterdir())
    own += [files("orthonav.ground.report").joinpath("static", name) for name in SHARED]
    paths = {f"/static/{entry.name}": entry for entry in own}
    leaflet = zip(LEAFLET, leaflet_files(*LEAFLET), strict=True)
    paths |= {f"/leaflet/{name}": path for name, path in leaflet}
    paths["/"] = paths.pop("/static/index.html")
    return {
        at: Response(HTTPStatus.OK, path.read_bytes(), MEDIA_TYPES[PurePath(path.name).suffix])
        for at, path in paths.items()
        if PurePath(path.name).suffix in MEDIA_TYPES
    }


class Pages:
    """Routes of the server. Safe to share between threads."""

    def __init__(self, run: Run, assets: dict[str, Response]) -> None:
        self._run, self._assets = run, assets
        png = partial(Response, HTTPStatus.OK, media_type="image/png")
        raw = partial(Response, HTTPStatus.OK, media_type="image/jpeg")
        number = r"(\d{1,9})"
        view = rf"/api/views/{number}"
        self._routes: dict[str, Callable[..., Response]] = {
            r"/api/run": lambda: _json(run.summary()),
            r"/api/views": lambda: _json(run.views()),
            view: lambda i: _json(run.detail(int(i))),
            rf"{view}/view\.png": lambda i: png(run.view_png(int(i))),
            rf"{view}/raw\.jpg": lambda i: raw(run.raw_jpeg(int(i))),
            rf"{view}/map-(fix|truth)\.png": lambda i, at: png(run.map_png(int(i), at)),
            rf"{view}/map-in-view\.png": lambda i: png(run.map_in_view_png(int(i))),
            rf"/tiles/{number}/{number}/{number}": self._tile,
            r"/preview\.jpg": self._preview,
        }

    def answer(self, target: str) -> Response:
        path = target.partition("?")[0]
        if path in self._assets:
            return self._assets[path]
        try:
            for pattern, made in self._routes.items():
                if match := re.fullmatch(pattern, path):
                    return made(*match.groups())
        except (IndexError, FlightError) as error:
            return _error(HTTPStatus.NOT_FOUND, str(error))
        except (OrthonavError, OSError) as error:
            return _error(HTTPStatus.INTERNAL_SERVER_ERROR, str(error))
        return _error(HTTPStatus.NOT_FOUND, "not found")

    def _tile(self, level: str, col: str, row: str) -> Response:
        found = self._run.sheet.tile(int(level), int(col), int(row))
        if found is None:
            return Response(HTTPStatus.NO_CONTENT)
        return Response(HTTPStatus.OK, *found, cache="private, max-age=86400")

    def _preview(self) -> Response:
        if not self._run.sheet.preview:
            return _error(HTTPStatus.NOT_FOUND, "the map has tiles")
        return Response(HTTPStatus.OK, self._run.sheet.preview, "image/jpeg")


def _json(plain: Any) -> Response:
    data = json.dumps(plain, allow_nan=False, separators=(",", ":")).encode("ascii")
    return Response(HTTPStatus.OK, data, "application/json")


def _error(status: HTTPStatus, said: str) -> Response:
    return Response(status, (" ".join(said.split()) + "\n").encode("utf-8", "replace"))


class Server(ThreadingHTTPServer):
    """Listens as soon as it is created; `serve_forever` responds."""

    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True

    def __init__(self, pages: Pages, port: int = 0) -> None:
        """Port 0 is any free port. Raises `OutputError` where it cannot listen."""
        try:
            super().__init__(("127.0.0.1", port), partial(Handler, pages))
        except (OSError, OverflowError) as error:
            why = getattr(error, "strerror", None) or error
            raise OutputError(f"cannot listen at port {port} ({why})") from error

    def server_bind(self) -> None:
        """Bind without the library's look-up of the host name, which may use the network."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = "127.0.0.1", int(self.server_address[1])

    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        log.debug("request of %s", client_address, exc_info=True)


def is_loopback(host: str) -> bool:
    """Whether a Host header names the loopback; at any port, because tunnels change it."""
    return bool(re.fullmatch(r"(localhost|127\.0\.0\.1|\[::1\])(:\d*)?", host, re.IGNORECASE))


class Handler(BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"
    server_version = "orthonav"
    sys_version = ""
    timeout = 60.0

    def __init__(self, pages: Pages, *arguments: Any) -> None:
        self._pages = pages
        super().__init__(*arguments)

    def do_GET(self) -> None:
        self._send(self._refused() or self._pages.answer(self.path))

    do_HEAD = do_GET  # noqa: N815 - a name of http.server

    def _refused(self) -> Response | None:
        hosts = self.headers.get_all("Host", [])
        if len(hosts) != 1 or not is_loopback(hosts[0]):
            return _error(HTTPStatus.MISDIRECTED_REQUEST, "this host name is not served")
        site = self.headers.get("Sec-Fetch-Site", "none")
        if site not in ("none", "same-origin") and self.path != "/":
            return _error(HTTPStatus.FORBIDDEN, "cross-site requests are refused")
        return None

    def _send(self, reply: Response) -> None:
        self.send_response(reply.status)
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.send_header("Cache-Control", reply.cache)
        if reply.status != HTTPStatus.NO_CONTENT:
            self.send_header("Content-Type", reply.media_type)
            self.send_header("Content-Length", str(len(reply.data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(reply.data)

    def log_message(self, format: str, *arguments: Any) -> None:
        log.debug(format, *arguments)
