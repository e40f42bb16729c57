"""Servers on the loopback: one that does what a test says, and a WMS of the ground."""

import json
import socket
import struct
import threading
import time
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qsl, urlsplit

import terrain

from orthonav.ground.fetch.web import RequestLimits

QUICK = RequestLimits(parallel=4, attempts=3, backoff_s=0.01, backoff_max_s=0.02)


@dataclass
class Asked:
    """A request: path, parameters by upper-case name, headers, how often it came before."""

    path: str
    query: dict
    headers: dict
    before: int
    body: bytes = b""
    target: str = ""


@dataclass
class Answer:
    """What is sent. `cut` ends the body early, `reset` breaks the connection, `slow_s` waits."""

    body: bytes = b""
    status: int = 200
    kind: str = "image/png"
    headers: dict = field(default_factory=dict)
    cut: int | None = None
    reset: bool = False
    slow_s: float = 0.0


class Silent(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request, client_address):
        pass  # a client that hung up


class Served:
    """A running server: `url`, and every request that came in `log`."""

    def __init__(self, answer):
        self.answer = answer
        self.log = []
        self.counts = Counter()
        self.lock = threading.Lock()
        server = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *args):
                pass

            def do_GET(self):
                server.handle(self, b"")

            def do_POST(self):
                server.handle(self, self.rfile.read(int(self.headers.get("Content-Length", 0))))

        self.http = Silent(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_address[1]}"
        self.tiles = f"xyz:{self.url}/{{z}}/{{x}}/{{y}}.png"
        self.file = f"cog:{self.url}/a.tif"
        self.catalogue = f"stac:{self.url}/api/"

    def handle(self, request, body):
        parts = urlsplit(request.path)
        query = {k.upper(): v for k, v in parse_qsl(parts.query, keep_blank_values=True)}
        with self.lock:
            before = self.counts[request.path]
            self.counts[request.path] += 1
            asked = Asked(parts.path, query, dict(request.headers), before, body, request.path)
            self.log.append(asked)
        answer = self.answer(asked)
        try:
            self.send(request, answer)
        except (BrokenPipeError, ConnectionResetError):
            request.close_connection = True

    def send(self, request, answer):
        time.sleep(answer.slow_s)
        if answer.reset:
            linger = struct.pack("ii", 1, 0)
            request.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            request.close_connection = True
            request.connection.close()
            return
        request.send_response(answer.status)
        if answer.kind:
            request.send_header("Content-Type", answer.kind)
        for name, value in answer.headers.items():
            request.send_header(name, value)
        if "Content-Length" not in answer.headers and answer.status != 204:
            request.send_header("Content-Length", str(len(answer.body)))
        request.end_headers()
        body = answer.body if answer.cut is None else answer.body[: answer.cut]
        request.wfile.write(body)
        if answer.cut is not None:
            request.close_connection = True


@contextmanager
def serving(answer):
    """A server that answers as the function says, meanwhile."""
    server = Served(answer)
    thread = threading.Thread(target=server.http.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.http.shutdown()
        server.http.server_close()
        thread.join()


def files(contents, ranges=True):
    """Answers with files by path, or with one at `/a.tif`, by ranges like any server of files."""
    contents = {"/a.tif": contents} if isinstance(contents, bytes) else contents

    def answer(asked):
        body = contents.get(asked.path)
        if body is None:
            return Answer(b"not here", 404, "text/plain")
        kind = "application/json" if asked.path.endswith(".json") else "image/tiff"
        wanted = asked.headers.get("Range")
        if not ranges or not wanted:
            return Answer(body, 200, kind, {"ETag": '"1"'})
        first, last = wanted.removeprefix("bytes=").split("-")
        part = body[int(first) : int(last) + 1]
        place = f"bytes {first}-{int(first) + len(part) - 1}/{len(body)}"
        return Answer(part, 206, kind, {"Content-Range": place, "ETag": '"1"'})

    return answer


@contextmanager
def searching(catalogue, refused=b""):
    """A STAC API with a search in pages of one; `server.searches` are those asked for, and one with
    the text `refused` fails."""
    items = {k: v for k, v in catalogue.items() if not k.startswith("/")}
    pictures = files({k: v for k, v in catalogue.items() if k.startswith("/")})

    def answer(asked):
        if refused and refused in asked.body:
            return Answer(b"no", 503)
        if asked.path == "/api/":
            links = [{"rel": "search", "href": "/api/search"}, {"rel": "child", "href": "/none"}]
            return Answer(terrain.plain({"type": "Catalog", "links": links}))
        if asked.path == "/api/search":
            body = json.loads(asked.body)
            server.searches.append(body)
            names = sorted(name for name in items if body.get("datetime", "")[:4] in name)
            if not names:
                return Answer(terrain.plain({"features": []}))
            at = names.index(body["token"]) if "token" in body else 0
            page = {"type": "FeatureCollection", "features": [items[names[at]]]}
            page["features"][0]["assets"]["data"]["href"] = f"{server.url}/{names[at]}.tif"
            if at + 1 < len(names):
                more = {"rel": "next", "href": "/api/search", "method": "POST", "merge": True}
                page["links"] = [more | {"body": {"token": names[at + 1]}}]
            return Answer(terrain.plain(page))
        if asked.path == "/api/token":
            return Answer(terrain.plain({"token": "se=1&sig=abcdefg"}))
        return pictures(asked)

    with serving(answer) as server:
        server.searches = []
        yield server


def tiles(asked):
    """The ground as web tiles at /Z/X/Y.png."""
    zoom, col, row = (int(part) for part in asked.path.rpartition(".")[0].split("/")[-3:])
    return Answer(terrain.encoded(terrain.mercator_tile(zoom, row, col)))


def wms_map(asked):
    """GetMap of the ground in any coordinate system, as WMS 1.1.1 (x, y always)."""
    west, south, east, north = (float(v) for v in asked.query["BBOX"].split(","))
    size = int(asked.query["WIDTH"]), int(asked.query["HEIGHT"])
    pixels = terrain.picture(west, south, east, north, *size, asked.query["SRS"])
    return Answer(terrain.encoded(pixels))
