"""A live page over a synthetic scene: for tests of the server."""

import threading
import time

import numpy as np

from rigwake.views.frames import FrameSet, place
from rigwake.views.present import Decoration
from rigwake.views.serve.feed import Newest
from rigwake.views.serve.screens import Screens
from rigwake.views.serve.server import LiveServer
from rigwake.views.surface import WaterAndShell
from view_scenes import attitude, four_cameras, photograph, water_and_ring


class Ticker(threading.Thread):
    """Puts a new scene ten times a second; the pictures roll by a few pixels, so that they differ."""

    def __init__(self, newest: Newest, rate_hz: float = 10.0) -> None:
        super().__init__(daemon=True)
        self.rig, self.newest, self.period_s = four_cameras(), newest, 1 / rate_hz
        self.stand = attitude(2.0, 1.0)
        self.images = photograph(self.rig, self.stand, water_and_ring())
        self.missing: dict[str, str] = {}
        self.ended = threading.Event()

    def run(self) -> None:
        surface = WaterAndShell(12.0)
        for number in range(10_000):
            if self.ended.wait(self.period_s):
                return
            stack = np.zeros((4, 480, 640, 3), dtype=np.uint8)
            for index, name in enumerate(self.rig.names):
                if name not in self.missing:
                    place(stack[index], np.roll(self.images[name], number % 3, axis=1))
            missing = dict(self.missing)
            frames = FrameSet(number * 10**8, self.rig.names, stack, missing, np.zeros(4))
            self.newest.put(frames, self.stand, surface, time.time())


def live_server(port: int = 0) -> tuple[LiveServer, Ticker]:
    newest = Newest()
    ticker = Ticker(newest)
    screens = Screens(ticker.rig, None, None, Decoration(), is_height_known=True)
    return LiveServer(newest, screens, "127.0.0.1", port), ticker
