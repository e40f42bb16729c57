"""Fetching in tests: without pauses, from servers on the loopback, and a real WMTS and WMS."""

import warnings
from socketserver import ThreadingMixIn
from threading import Thread
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

import pytest
import servers
import terrain
from servers import QUICK

from orthonav.ground.fetch.presets import ImageryOptions, parse_source
from orthonav.ground.fetch.run import FetchRequest, fetch
from orthonav.ground.planning.area import Area

MAPPROXY = """
services:
  wms:
    srs: ['EPSG:3857', 'EPSG:2154', 'EPSG:4326', 'EPSG:3035', 'EPSG:32631']
    image_formats: ['image/png', 'image/jpeg']
    versions: ['1.1.1', '1.3.0']
  wmts: {kvp: true, restful: true}
layers:
  - {name: ortho, title: Ortho, sources: [ground]}
  - {name: tiles, title: Tiles, tile_sources: [in_mercator, in_lambert, in_utm]}
caches:
  in_mercator: {grids: [mercator], sources: [ground], disable_storage: true}
  in_lambert: {grids: [lambert], sources: [ground], disable_storage: true}
  in_utm: {grids: [utm], sources: [ground], disable_storage: true}
sources:
  ground:
    type: wms
    req: {url: 'UPSTREAM', layers: ground, format: image/png}
    wms_opts: {version: 1.1.1}
grids:
  mercator: {base: GLOBAL_WEBMERCATOR}
  lambert:
    {srs: 'EPSG:2154', bbox: [0, 6000000, 1300000, 7200000], origin: nw, res: [16, 8, 4, 2, 1, 0.5]}
  utm: {srs: 'EPSG:32631', bbox: [100000, 4900000, 900000, 5500000], origin: nw, res: [8, 4, 2, 1]}
globals:
  cache: {base_dir: 'CACHE', meta_size: [1, 1], meta_buffer: 0}
"""


class Quiet(WSGIRequestHandler):
    def log_message(self, *args):
        pass


class Threaded(ThreadingMixIn, WSGIServer):
    daemon_threads = True


@pytest.fixture(scope="session")
def mapproxy(tmp_path_factory):
    """Address of a MapProxy that serves the ground as WMTS and WMS."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those of MapProxy
        from mapproxy.wsgiapp import make_wsgi_app

        with servers.serving(servers.wms_map) as upstream:
            folder = tmp_path_factory.mktemp("mapproxy")
            config = MAPPROXY.replace("UPSTREAM", f"{upstream.url}/map")
            (folder / "proxy.yaml").write_text(config.replace("CACHE", str(folder / "cache")))
            app = make_wsgi_app(str(folder / "proxy.yaml"))
            http = make_server("127.0.0.1", 0, app, Threaded, Quiet)
            thread = Thread(target=http.serve_forever, args=(0.01,), daemon=True)
            thread.start()
            yield f"http://127.0.0.1:{http.server_address[1]}"
            http.shutdown()
            http.server_close()
            thread.join()


@pytest.fixture
def take(tmp_path):
    """Function that fetches the square around the middle and returns the result and the file;
    `source`: as on the command line, or a spec."""

    def taken(source, half_m=110.0, out="ortho.tif", limits=QUICK, terms=None, **rest):
        names = ImageryOptions.__dataclass_fields__.keys() & rest.keys()
        asked = {"gsd_m": 1.0} | {name: rest.pop(name) for name in names}
        spec = source
        if isinstance(source, str):
            spec = parse_source(source, ImageryOptions(**asked), **(terms or {}))
        request = FetchRequest(
            spec=spec,
            area=rest.pop("area", None) or Area.from_bounds(terrain.bounds(half_m)),
            out=tmp_path / out,
            margin_m=rest.pop("margin_m", 0.0),
            compress=rest.pop("compress", "deflate"),
            limits=limits,
            **rest,
        )
        return fetch(request), request.out

    return taken


@pytest.fixture(scope="session")
def cog_bytes(tmp_path_factory):
    """A cloud-optimized file of the ground in UTM, 500 m across at 1 m, as bytes."""
    path = terrain.write_tif(
        tmp_path_factory.mktemp("cog") / "terrain.tif", "EPSG:32631", size=500, driver="COG"
    )
    return path.read_bytes()
