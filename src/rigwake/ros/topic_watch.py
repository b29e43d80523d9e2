"""How regularly a topic comes: rate, gaps, silence, stamps that run back."""

from __future__ import annotations

import threading
from collections import deque
from itertools import pairwise
from statistics import median

from rigwake.readers.channels import Encoding
from rigwake.readers.ros_decoding import read_header
from rigwake.ros.transport import NodeStatus, StatusLevel

_WINDOW = 200  # messages
_WINDOW_S = 10.0
_SILENT_S, _SILENT_PERIODS = 2.0, 5.0
_GAP_PERIODS = 3.0
_BACK_NS = 1_000_000


class TopicWatch:
    """Told every message of one topic; says how the topic does. Times are seconds of a steady clock."""

    def __init__(self, topic: str, *, is_stamped: bool = True, is_sent_once: bool = False) -> None:
        self.topic = topic
        self.messages = 0
        self.backwards = 0
        self._is_stamped, self._is_sent_once = is_stamped, is_sent_once
        self._last_stamp_ns: int | None = None
        self._times: deque[float] = deque(maxlen=_WINDOW)
        self._lock = threading.Lock()

    def received(self, payload: bytes, encoding: Encoding, now_s: float) -> None:
        """Another message."""
        header = read_header(payload[:256], encoding) if self._is_stamped else None
        with self._lock:
            self.messages += 1
            self._times.append(now_s)
            if header is None:
                return
            if self._last_stamp_ns is not None and header.stamp_ns < self._last_stamp_ns - _BACK_NS:
                self.backwards += 1
            self._last_stamp_ns = header.stamp_ns

    def status(self, now_s: float) -> NodeStatus:
        """Rate over the last 10 s, longest gap in them, silence."""
        with self._lock:
            times = [t for t in self._times if now_s - t <= _WINDOW_S]
            last = self._times[-1] if self._times else None
            periods = [b - a for a, b in pairwise(self._times)]
        if self._is_sent_once and last is not None:
            return NodeStatus(self.topic, StatusLevel.OK, "received", {"messages": str(self.messages)})
        period = median(periods) if periods else 0.0
        if last is None or now_s - last > max(_SILENT_S, _SILENT_PERIODS * period):
            silence = "nothing yet" if last is None else f"silent for {now_s - last:.0f} s"
            return NodeStatus(self.topic, StatusLevel.STALE, silence, {"messages": str(self.messages)})
        gaps = [b - a for a, b in pairwise(times)]
        longest = max(gaps, default=0.0)
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else 0.0
        values = {
            "rate_hz": f"{rate:.2f}",
            "longest_gap_s": f"{longest:.3f}",
            "messages": str(self.messages),
            "stamps_backwards": str(self.backwards),
        }
        words = f"{rate:.1f} Hz"
        if len(gaps) > 3 and longest > max(_GAP_PERIODS * period, 0.1):
            return NodeStatus(self.topic, StatusLevel.WARN, f"{words}, a gap of {longest:.1f} s", values)
        return NodeStatus(self.topic, StatusLevel.OK, words, values)
