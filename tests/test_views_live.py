"""The live server without a browser, and live sources."""

import http.client
import json
import struct
import time
from pathlib import Path

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from live_pages import live_server
from rigwake.errors import InputError, UsageError
from rigwake.views.frames import FrameWatch
from rigwake.views.live import live_feed, paired, parse_sources
from rigwake.views.prepare import SurroundOptions
from rigwake.views.present import Decoration
from rigwake.views.serve.feed import Newest
from rigwake.views.serve.screens import Screens
from rigwake.views.serve.server import LiveServer, ServerThread
from rigwake.views.video import video_file
from test_surround_cli import write_rig
from view_scenes import four_cameras

RIG = four_cameras()


@pytest.fixture(scope="module")
def page():
    server, ticker = live_server()
    with ServerThread(server):
        ticker.start()
        yield server
        ticker.ended.set()


def get(server, path: str, **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, body


def parsed(message: bytes) -> tuple[dict, bytes]:
    length = struct.unpack("<I", message[:4])[0]
    return json.loads(message[4 : 4 + length]), message[4 + length :]


def ask(socket, **request) -> dict | tuple[dict, bytes]:
    socket.send(json.dumps(request))
    answer = socket.recv(timeout=20)
    return json.loads(answer) if isinstance(answer, str) else parsed(answer)


def test_nothing_but_the_page_is_served(page) -> None:
    assert get(page, "/")[0] == 200
    assert b"rigwake surround" in get(page, "/")[1]
    assert get(page, "/bowl.js")[0] == 200
    for path in (
        "/server.py",
        "/../server.py",
        "/..%2f..%2fserver.py",
        "//etc/passwd",
        "/view.js/../server.py",
        "/%2e%2e/",
    ):
        status, body = get(page, path)
        assert status == 404, path
        assert b"import" not in body


def test_other_names_and_other_pages_are_kept_out(page) -> None:
    assert get(page, "/", Host="evil.example")[0] == 403
    assert get(page, "/", Host=f"localhost:{page.port}")[0] == 200
    address = f"ws://127.0.0.1:{page.port}/live"
    with pytest.raises(InvalidStatus), connect(address, origin="http://evil.example"):
        pass
    with connect(address, origin=f"http://127.0.0.1:{page.port}") as socket:
        assert socket.recv(timeout=10)


def test_two_viewers_get_the_newest_picture_each(page) -> None:
    address = f"ws://127.0.0.1:{page.port}/live"
    with connect(address) as fast, connect(address) as slow:
        assert json.loads(fast.recv(timeout=10))["cameras"] == list(RIG.names)
        slow.recv(timeout=10)
        first, _ = ask(slow, view="panorama")
        numbers = [ask(fast, view="topdown")[0]["number"] for _ in range(6)]
        assert numbers == sorted(set(numbers))
        time.sleep(0.5)
        second, jpeg = ask(slow, view="panorama")
        assert second["number"] >= first["number"] + 5  # those between were not kept for it
        assert time.time() - second["taken_s"] < 1.0
        assert jpeg[:2] == b"\xff\xd8"
        assert second["lengths"] == [len(jpeg)]
        header, mesh = ask(slow, view="mesh")
        count = header["rows"] * header["columns"]
        values = np.frombuffer(mesh, "<f4")
        assert len(values) == 3 * count * 5
        weights = values[3 * count :].reshape(4, count, 3)[..., 2].sum(axis=0)
        assert np.all((np.abs(weights - 1) < 1e-4) | (weights == 0))
        bowl, _ = ask(slow, view="bowl")
        assert len(bowl["lengths"]) == 4


def test_strange_requests_do_no_harm(page) -> None:
    address = f"ws://127.0.0.1:{page.port}/live"
    with connect(address) as socket:
        socket.recv(timeout=10)
        for view, camera in (("../../etc/passwd", ""), ("camera", "../front"), ("", ""), ("camera", "")):
            assert ask(socket, view=view, camera=camera)["kind"] == "refused"
        socket.send("no json")
        with pytest.raises(ConnectionClosed):
            socket.recv(timeout=10)
    with connect(address) as socket:
        socket.recv(timeout=10)
        socket.send("x" * 10_000)
        with pytest.raises(ConnectionClosed):
            socket.recv(timeout=10)
    assert get(page, "/")[0] == 200


def test_port_in_use_is_said(page) -> None:
    screens = Screens(RIG, None, None, Decoration(), is_height_known=True)
    second = LiveServer(Newest(), screens, "127.0.0.1", page.port)
    with pytest.raises(UsageError, match="another port"), ServerThread(second):
        pass


def test_sources_are_checked() -> None:
    assert parse_sources(["front=rtsp://a/b?c=d", "left=/dev/video0"], RIG)["front"] == "rtsp://a/b?c=d"
    for wrong in ("front", "front=", "bow=/dev/video0"):
        with pytest.raises(UsageError):
            parse_sources([wrong], RIG)


def test_pairing_waits_for_all_but_the_silent() -> None:
    image = np.full((480, 640, 3), 90, np.uint8)
    now = 10**18
    pictures = {n: [(now - k * 10**8, image + k) for k in (3, 2, 1)] for n in ("front", "left", "back")}
    pictures["left"] = pictures["left"][:-1]  # one behind
    pictures["back"] = [(now - 3 * 10**9, image)]
    watches = {n: FrameWatch() for n in RIG.names}
    frames = paired(RIG, pictures, {"back": "broken pipe"}, now, watches)
    assert frames is not None
    assert frames.timestamp_ns == now - 2 * 10**8
    assert dict(frames.missing) == {"back": "broken pipe", "right": "silent"}
    assert frames.stack[0, 0, 0, 0] == 92
    assert paired(RIG, {}, {}, now, watches) is None


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("videos")
    write_rig(folder / "rig.yaml")
    rng = np.random.default_rng(3)
    picture = rng.integers(30, 220, (60, 80, 3), dtype=np.uint8).repeat(8, axis=0).repeat(8, axis=1)
    with video_file(folder / "camera.mp4", 640, 480, 10.0, is_sphere=False) as video:
        for k in range(15):
            video.write(np.roll(picture, 8 * k, axis=1), k * 10**8)
    return folder


def test_video_files_as_live_sources(videos: Path) -> None:
    specs = [f"{name}={videos / 'camera.mp4'}" for name in RIG.names[:3]]
    options = SurroundOptions(stabilise="off", height_m=1.9)
    feed, newest, screens = live_feed(videos / "rig.yaml", specs, options, Decoration())
    feed.start()
    try:
        until = time.monotonic() + 15
        while (scene := newest.get()) is None or scene.number < 6:
            assert time.monotonic() < until, newest.error
            time.sleep(0.05)
        assert scene.frames.missing == {"right": "no source given"}
        assert np.nanmax(np.abs(scene.frames.offsets_s)) < 0.06
        header, _ = parsed(screens.message(scene, "panorama", ""))
        assert header["missing"] == {"right": "no source given"}
    finally:
        feed.stop()


def test_sources_that_give_nothing_are_named(videos: Path) -> None:
    with pytest.raises(InputError, match="front: "):
        live_feed(videos / "rig.yaml", ["front=/nowhere/at/all.mp4"], SurroundOptions(), Decoration())
    (videos / "text.mp4").write_text("no video")
    with pytest.raises(InputError, match="front: "):
        live_feed(videos / "rig.yaml", [f"front={videos / 'text.mp4'}"], SurroundOptions(), Decoration())
