"""Readers for `tools.fuzz`: what makes small whole files in a folder, and what reads one."""

import contextlib
import http.client
import json
import shutil
import socket
import sys
import threading
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

TESTS = Path(__file__).resolve().parents[1] / "tests"
FOLDERS = ("", "recordings", "onboard", "localize", "geo", "mapfile", "imagery", "fetch", "view")
sys.path.extend(str(TESTS / folder) for folder in FOLDERS)

import bags
import geotiffs
import maps
import recorders
import small_run
import test_camera_files as camera_files
import test_capabilities as capabilities
import test_crafted_parts as crafted
import test_flightlog
import test_route_markup as markup
import test_route_missions as missions
from benchmarks.fakes import Port, Time
from examples.simulated_autopilot import Encoder, mavlink

from orthonav.core.flight import fixes, gnss, mount, open_flight, read_truth
from orthonav.core.geo.camera_files import read_camera_file
from orthonav.core.mapfile import signature
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.terrain import open_dem
from orthonav.ground.planning.route import read_route
from orthonav.ground.recordings import SourceOptions, open_source
from orthonav.ground.recordings.logs import read_log
from orthonav.ground.view.run import Run, ViewRequest
from orthonav.ground.view.server import Pages, Server, load_assets
from orthonav.onboard import state
from orthonav.onboard.link import AutopilotLink
from orthonav.onboard.telemetry import TelemetryBuffer

Make, Read = Callable[[Path], list[Path]], Callable[[Path], object]


def played(path: Path, **options: Any) -> None:
    for view in islice(open_source(path, SourceOptions(**options)).views, 6):
        view.grey()


def written(root: Path, **texts: str | bytes) -> list[Path]:
    """Files of these names, whose last underscore stands for a dot."""
    paths = [root / ".".join(name.rsplit("_", 1)) for name in texts]
    for path, text in zip(paths, texts.values(), strict=True):
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return paths


def make_manifest(root: Path) -> list[Path]:
    (root / "a.onav").touch()
    return written(root, a_json=json.dumps(maps.taken_apart(crafted.GOLDEN)[1]))


def read_manifest(path: Path) -> None:
    header, _, data = maps.taken_apart(crafted.GOLDEN)
    plain: Any = path.read_text("latin-1")
    with contextlib.suppress(ValueError, RecursionError):
        plain = json.loads(plain)  # then its digest is put right
    with contextlib.suppress(RecursionError):
        maps.put_together(path.with_name("a.onav"), header, plain, data)
    crafted.used(path.with_name("a.onav"))


def make_signed(root: Path) -> list[Path]:
    signature.new_key(root)
    area = shutil.copy(crafted.GOLDEN, root / "a.onav")
    return [root / "public.pem", signature.sign_map(area, root / "private.pem")]


def make_ortho(root: Path) -> list[Path]:
    tiled = {"compress": "deflate", "tiled": True, "blockxsize": 64, "blockysize": 64}
    scene = geotiffs.smooth_scene()
    return [geotiffs.write(root / f"{i}.tif", scene, **more) for i, more in enumerate(({}, tiled))]


def read_ortho(path: Path) -> None:
    place = {"west_m": -50.0, "north_m": 50.0, "gsd_m": 1.0, "width_px": 100, "height_px": 100}
    with Mosaic.open([path]).sheet(geotiffs.FRAME, **place) as sheet:
        sheet.read_grey(0, 0, 100, 100)


def make_terrain(root: Path) -> list[Path]:
    heights = np.linspace(0, 99, 900, dtype=np.float32).reshape(1, 30, 30)
    return [geotiffs.write(root / "a.tif", heights)]


def make_routes(root: Path) -> list[Path]:
    points = missions.A, missions.B
    waypoints = [f"{i}\t0\t3\t16\t0\t0\t0\t0\t46.5{i}\t2.5\t60\t1\n" for i in range(3)]
    kml = markup.kml_of(("way", markup.line("absolute")), ("b", markup.TRACK))
    line = {"type": "LineString", "coordinates": [[2.5, 46.5, 60], [2.6, 46.6, 70]]}
    return written(
        root,
        a_geojson=json.dumps({"type": "Feature", "properties": {"band_m": 9}, "geometry": line}),
        a_plan=json.dumps(missions.plan(*(missions.simple(16, each, 60) for each in points))),
        b_plan=json.dumps(missions.plan(missions.transects("survey", points))),
        a_waypoints="QGC WPL 110\n" + "".join(waypoints),
        a_csv="latitude,longitude,altitude(m),altitudemode\n46.5,2.5,60,1\n46.6,2.6,60,0\n",
        a_gpx='<gpx><rte><rtept lat="46.5" lon="2.5"><ele>60</ele></rtept></rte></gpx>',
        **{"a_kml": kml, "a_kmz": markup.archive(("doc.kml", kml))},
    )


def make_logs(root: Path) -> list[Path]:
    table = [f"{i},{i},1,2,100,46.5,2.5\n" for i in range(9)]
    return [
        recorders.ulog(root / "a.ulg", recorders.px4_topics(2)),
        recorders.dataflash(root / "a.bin", 2),
        recorders.tlog(root / "a.tlog", 2),
        recorders.subtitles(root / "a.srt", [recorders.dji_subtitle(n) for n in range(20)]),
        *written(
            root, a_csv="".join(["time_s,yaw_deg,pitch_deg,roll_deg,agl_m,lat,lon\n", *table])
        ),
    ]


def read_telemetry(path: Path) -> None:
    track = read_log(path, (0.0, 0.0, 0.0))
    for time_ns in np.linspace(*track.span_ns(), 5).astype(int).tolist():
        track.telemetry(time_ns)
        track.latlon_deg(time_ns)


def make_photos(root: Path) -> list[Path]:
    place, tags = recorders.place(46.5, 2.5), {"camera_pitch": -90.0, "camera_roll": 0.0}
    notes = recorders.maker_notes(yaw=1.0, camera_yaw=2.0, **tags)
    paths = [root / name for name in ("a.jpg", "b.tif", "c.png")]
    photos = [recorders.photo(path, gps=place, xmp=recorders.dji()) for path in paths]
    return [*photos, recorders.photo(root / "d.jpg", gps=place, more={0x927C: notes})]


def make_table(root: Path) -> list[Path]:
    make_photos(root)
    rows = "a.jpg,2024-05-01T10:00:01Z,1,1,2,120,46.5,2.5\nc.png,1714557602,3,1,2,120,46.5,2.5\n"
    return written(root, poses_csv=f"file,time,yaw,pitch,roll,agl,lat,lon\n{rows}")


def make_video(root: Path) -> list[Path]:
    recorders.camera_file(root / "camera.json")
    subtitles = [recorders.dji_subtitle(n) for n in range(6)]
    path = recorders.video(root / "a.mp4", 6, 10.0, "mp4v")
    return [path, recorders.subtitles(root / "a.srt", subtitles)]


def read_video(path: Path) -> None:
    played(path.with_name("a.mp4"), camera=path.with_name("camera.json"), rate_hz=5.0)


def make_bag(root: Path, form: str) -> list[Path]:
    messages = bags.Messages(ros1=form == "bag")
    path = bags.record(root / "b", bags.flight(messages, 1), messages, form)
    return [path] if path.is_file() else sorted(path.iterdir())


def make_folder(root: Path) -> list[Path]:
    folder = small_run.write_small_flight(root / "flight")
    gnss.write_gnss(folder / "gnss.csv", [gnss.GnssSample(10**11, 10**11, 46.5, 2.5, 3, 1.5)] * 3)
    names = ("telemetry.csv", "flight.json", "truth.csv", "gnss.csv")
    return [*(folder / name for name in names), next((folder / "frames").iterdir())]


def read_folder(path: Path) -> None:
    folder = path.parent.parent if path.parent.name == "frames" else path.parent
    read_truth(folder / "truth.csv")
    gnss.read_gnss(folder / "gnss.csv")
    for view in open_flight(folder).views[:6]:
        view.grey()


def make_fixes(root: Path) -> list[Path]:
    fixes.write_results(root / "a.jsonl", [small_run.result(i) for i in range(4)])
    return [root / "a.jsonl"]


def make_small(root: Path) -> list[Path]:
    mount.write_mount(root / "mount.json", test_flightlog.MOUNT)
    mount.write_latency(root / "latency.json", mount.CameraLatency(120.0, 10.0))
    state.save(root / "state.json", state.SavedState(46.5, 2.5, 3.0, 1, 1, "a"), {"a": {"b": 1}})
    written(root, ros_json='{"/**": {"ros__parameters": {"altitude": "none"}}}')
    return sorted(root.iterdir())


SMALL: dict[str, Read] = {
    "mount": mount.read_mount,
    "latency": mount.read_latency,
    "state": lambda path: (state.load(path), state.learnt_biases(path)),
}


def make_cameras(root: Path) -> list[Path]:
    camera_files.ros(root / "ros.yaml")
    camera_files.kalibr(root / "kalibr.yaml")
    recorders.camera_file(root / "own.json")
    for suffix in ("yaml", "json", "xml"):
        camera_files.opencv(root / f"opencv.{suffix}")
    return sorted(root.iterdir())


def make_mavlink(root: Path) -> list[Path]:
    says, data = Encoder(), b""
    for ns in range(0, 500_000_000, 50_000_000):
        data += says.heartbeat() + says.attitude(ns, yaw_deg=30.0) + says.distance(ns, 80.0)
        data += says.local(ns, (1.0, 2.0, 0.0), -80.0) + says.home(ns, 80.0) + says.timesync(ns, 1)
    return written(root, a_mavlink=data)


def read_mavlink(path: Path) -> None:
    """With checksums put right."""
    data, time, port, at = bytearray(path.read_bytes()), Time(), Port(), 0
    while (at := data.find(b"\xfd", at)) >= 0 and at + 12 <= len(data):
        end = at + 10 + data[at + 1]
        known = mavlink.mavlink_map.get(int.from_bytes(data[at + 7 : at + 10], "little"))
        if known is not None and end + 2 <= len(data):
            crc = mavlink.x25crc(data[at + 1 : end])
            crc.accumulate(bytes([known.crc_extra]))
            data[end : end + 2] = crc.crc.to_bytes(2, "little")
        at = end
    link = AutopilotLink(port.open, TelemetryBuffer(), time.clocks)
    port.coming = [bytes(data[i : i + 200]) for i in range(0, len(data), 200)]
    while port.coming:
        link.poll()
        time.go(0.01)
        link.state_at(time.now_ns).telemetry(time.now_ns)


SERVICES = {"ign_wmts": ("ign", "wmts", ""), "ign_wms": ("ign-wms", "wms", "wms-r/wms")}


def make_capabilities(root: Path) -> list[Path]:
    return [Path(shutil.copy(capabilities.FOLDER / f"{name}.xml", root)) for name in SERVICES]


def read_capabilities(path: Path) -> None:
    preset, protocol, suffix = SERVICES[path.stem]
    path.write_text(path.read_text("utf-8", "replace"), "utf-8")  # the test reads it as text
    capabilities.FOLDER, options = path.parent, capabilities.of_preset(preset, "2021", gsd_m=0.5)
    capabilities.requested(path.parent, path.stem, options, protocol, suffix)
    (path.parent / "o.tif").unlink()


PORTS: list[int] = []
TARGETS = ("/", "/api/run", "/views/1/view.png", "/tiles/0/0/0", "/api/views")


def make_requests(root: Path) -> list[Path]:
    flight, area = small_run.write_small_flight(root / "flight"), root / "area.onav"
    small_run.write_small_map(area)
    opened = Run(ViewRequest(*make_fixes(root), area, flight=flight))
    server = Server(Pages(opened, load_assets()))
    PORTS.append(server.server_port)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    rest = "HTTP/1.1\r\nHost: localhost\r\nAccept: */*\r\nConnection: close\r\n\r\n"
    return written(root, **{f"{i}_http": f"GET {each} {rest}" for i, each in enumerate(TARGETS)})


def read_requests(path: Path) -> None:
    """The server serves others afterwards."""
    there = "127.0.0.1", PORTS[-1]
    with socket.create_connection(there, 10) as asked, contextlib.suppress(OSError):
        asked.sendall(path.read_bytes())
        asked.shutdown(socket.SHUT_WR)
        while asked.recv(65536):
            pass
    connection = http.client.HTTPConnection(*there, timeout=10)
    connection.request("GET", "/")
    assert connection.getresponse().status == 200
    connection.close()


READERS: dict[str, tuple[Make, Read]] = {
    "manifest": (make_manifest, read_manifest),
    "signature": (
        make_signed,
        lambda path: signature.require_signature(
            path.parent / "a.onav", path.parent / "public.pem"
        ),
    ),
    "orthophoto": (make_ortho, read_ortho),
    "terrain": (
        make_terrain,
        lambda path: open_dem(path, "msl")(*geotiffs.FRAME.latlon_from_en(np.zeros((2, 2)))),
    ),
    "route": (
        make_routes,
        lambda path: read_route(path.with_name(f"{path.name}#1") if ".km" in path.name else path),
    ),
    "log": (make_logs, read_telemetry),
    "photo": (make_photos, lambda path: played(path, fov_deg=60.0)),
    "table": (make_table, lambda path: played(path.parent, fov_deg=60.0)),
    "video": (make_video, read_video),
    "bag": (lambda root: make_bag(root, "bag"), played),
    "db3": (lambda root: make_bag(root, "db3"), lambda path: played(path.parent)),
    "mcap": (lambda root: make_bag(root, "mcap"), lambda path: played(path.parent)),
    "flight-log": (lambda root: [test_flightlog.short_log(root)], played),
    "flight": (make_folder, read_folder),
    "fixes": (make_fixes, lambda path: (fixes.read_results(path), fixes.read_identity(path))),
    "camera": (make_cameras, read_camera_file),
    "small": (make_small, lambda path: SMALL[path.stem](path)),
    "mavlink": (make_mavlink, read_mavlink),
    "capabilities": (make_capabilities, read_capabilities),
    "requests": (make_requests, read_requests),
}
