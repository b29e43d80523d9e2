"""The live page: HTTP and WebSocket on one port, this machine only by default.

A viewer asks for a picture and gets the newest one that it has not had; it asks again when it has shown it. A slow
viewer so sees fewer pictures, never older ones.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import json
import threading
from collections.abc import Callable
from importlib import resources
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from rigwake.errors import RigwakeError, UsageError
from rigwake.views.prepare import SurroundSetup
from rigwake.views.present import Decoration
from rigwake.views.serve.feed import LiveScene, Newest, RecordingFeed
from rigwake.views.serve.screens import Screens

_FILES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/view.js": ("view.js", "text/javascript; charset=utf-8"),
    "/bowl.js": ("bowl.js", "text/javascript; charset=utf-8"),
}
_LIVE = "/live"
_LARGEST_REQUEST = 4096
_WAIT_S = 5.0  # without news a viewer is told so
_POLICY = (
    "default-src 'self'; img-src 'self' blob:; connect-src 'self' ws: wss:; style-src 'self' 'unsafe-inline'"
)


class LiveServer:
    """Serves the page and the newest scenes."""

    def __init__(self, newest: Newest, screens: Screens, host: str = "127.0.0.1", port: int = 0) -> None:
        self.host, self.port = host, port
        self._newest, self._screens = newest, screens
        self._news: asyncio.Condition | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        newest.listen(self._tell)

    @property
    def address(self) -> str:
        """Where a browser finds the page, once it runs."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/"

    async def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Serve until cancelled. Raises UsageError if the port cannot be used."""
        self._loop, self._news = asyncio.get_running_loop(), asyncio.Condition()
        try:
            server: Server = await serve(
                self._viewer,
                self.host,
                self.port,
                process_request=self._request,
                max_size=_LARGEST_REQUEST,
                compression=None,
                max_queue=4,
                write_limit=2**16,
            )
        except (OSError, OverflowError) as error:
            raise UsageError(
                f"{self.host}:{self.port} cannot be served on ({error}).",
                remedy="Choose another port: --serve PORT.",
            ) from error
        async with server:
            self.port = server.sockets[0].getsockname()[1]
            ready()
            await server.serve_forever()

    def _tell(self) -> None:
        """From any thread: wake up all viewers."""
        if self._loop is not None and not self._loop.is_closed():
            with contextlib.suppress(RuntimeError):  # closed in between
                self._loop.call_soon_threadsafe(lambda: asyncio.ensure_future(self._wake()))

    async def _wake(self) -> None:
        if self._news is not None:
            async with self._news:
                self._news.notify_all()

    def _request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer plain HTTP; let the WebSocket of the page through."""
        host = request.headers.get("Host", "")
        if not _is_expected_host(host, self.host):
            return _answer(403, "Forbidden", b"This host name is not served.\n")
        path = request.path.split("?", 1)[0]
        if path == _LIVE:
            origin = request.headers.get("Origin")
            if origin is not None and origin.split("://", 1)[-1] != host:
                return _answer(403, "Forbidden", b"Other pages may not look.\n")
            return None
        if path not in _FILES:
            return _answer(404, "Not Found", b"There is no such page.\n")
        name, kind = _FILES[path]
        body = resources.files("rigwake.views.serve").joinpath(name).read_bytes()
        return _answer(200, "OK", body, kind)

    async def _viewer(self, connection: ServerConnection) -> None:
        seen = 0
        with contextlib.suppress(ConnectionClosed):
            await connection.send(json.dumps({"kind": "hello", "cameras": list(self._screens.rig.names)}))
            async for text in connection:
                wanted = _parsed(text)
                if wanted is None:
                    await connection.close(1008, "not a request")
                    return
                scene = await self._newer_than(0 if wanted.get("again") else seen)
                if scene is None:
                    words = self._newest.error or "no pictures come in"
                    await connection.send(json.dumps({"kind": "waiting", "words": words}))
                    continue
                seen = scene.number
                await connection.send(await self._answer_to(wanted, scene))

    async def _answer_to(self, wanted: dict[str, Any], scene: LiveScene) -> bytes | str:
        screen, camera = str(wanted.get("view", "")), str(wanted.get("camera", ""))
        try:
            if screen == "mesh":
                if not self._screens.is_height_known:
                    return json.dumps(
                        {"kind": "refused", "words": "The height above the water is not known."}
                    )
                return await asyncio.to_thread(self._screens.mesh, scene)
            return await asyncio.to_thread(self._screens.message, scene, screen, camera)
        except RigwakeError as error:
            return json.dumps({"kind": "refused", "words": str(error)})

    async def _newer_than(self, seen: int) -> LiveScene | None:
        """The newest scene once it is newer than `seen`; None if none comes in time."""
        assert self._news is not None

        def is_there() -> bool:
            scene = self._newest.get()
            return scene is not None and scene.number > seen

        try:
            async with asyncio.timeout(_WAIT_S):
                async with self._news:
                    await self._news.wait_for(is_there)
        except TimeoutError:
            return None
        return self._newest.get()


def _parsed(text: str | bytes) -> dict[str, Any] | None:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def _is_expected_host(host: str, bound: str) -> bool:
    """Whether a request names this server; a page of another name that resolves here (DNS rebinding) does not."""
    name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
    name = name.strip("[]")
    if name in ("localhost", bound):
        return True
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return not _is_loopback(
            bound
        )  # served to a network by choice: names of machines are its users' business
    return address.is_loopback or not _is_loopback(bound)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _answer(status: int, reason: str, body: bytes, kind: str = "text/plain; charset=utf-8") -> Response:
    headers = Headers(
        [
            ("Content-Type", kind),
            ("Content-Length", str(len(body))),
            ("Cache-Control", "no-store"),
            ("X-Content-Type-Options", "nosniff"),
            ("Content-Security-Policy", _POLICY),
            ("Connection", "close"),
        ]
    )
    return Response(status, reason, headers, body)


def serve_recording(
    setup: SurroundSetup, decoration: Decoration, host: str, port: int, say: Callable[[str], None] = print
) -> None:
    """Play a recording live until interrupted."""
    newest = Newest()
    screens = Screens(setup.rig, setup.masks, setup.colour, decoration, setup.height is not None)
    feed = RecordingFeed(setup, newest)
    feed.start()
    try:
        run_server(LiveServer(newest, screens, host, port), say)
    finally:
        feed.stop()


def run_server(server: LiveServer, say: Callable[[str], None] = print) -> None:
    """Serve until interrupted."""
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(server.run(lambda: say(f"{server.address}   (Ctrl-C ends)")))


class ServerThread(threading.Thread):
    """A server beside other work; `stop` ends it."""

    def __init__(self, server: LiveServer) -> None:
        super().__init__(daemon=True, name="live server")
        self.server = server
        self._ready = threading.Event()
        self._task: asyncio.Task[None] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self.error: Exception | None = None

    def run(self) -> None:
        """Serve until stopped."""

        async def main() -> None:
            self._loop = asyncio.get_running_loop()
            self._task = asyncio.ensure_future(self.server.run(self._ready.set))
            with contextlib.suppress(asyncio.CancelledError):
                await self._task

        try:
            asyncio.run(main())
        except RigwakeError as error:
            self.error = error
        self._ready.set()

    def __enter__(self) -> ServerThread:
        self.start()
        self._ready.wait(10)
        if self.error is not None:
            raise self.error
        return self

    def __exit__(self, *_: object) -> None:
        if self._loop is not None and self._task is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._task.cancel)
        self.join(5)
