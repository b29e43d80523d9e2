"""A ROS 1 graph on loopback for tests: rosmaster, the node, a player, and calls from outside."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import rigwake

SYSTEM_PYTHON = "/usr/bin/python3"
PLAYER = Path("/usr/lib/rosbag/play")
WANTED = ("rospy", "rosgraph", "tf2_ros", "std_srvs", "diagnostic_msgs", "sensor_msgs", "geometry_msgs")

# runs under the system's interpreter: what another node sees of ours
LOOK = """
import json, sys, time
import rospy, tf2_ros
from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import SetBool, Trigger
rospy.init_node("look", anonymous=True, disable_rostime=True)
what, words = sys.argv[1], sys.argv[2:]
if what == "diagnostics":
    found = rospy.wait_for_message("/diagnostics", DiagnosticArray, timeout=15)
    print(json.dumps({s.name.partition(": ")[2]: [s.level if isinstance(s.level, int) else ord(s.level), s.message,
          {v.key: v.value for v in s.values}] for s in found.status}))
elif what == "record":
    rospy.wait_for_service("/rigwake/record", 15)
    answer = rospy.ServiceProxy("/rigwake/record", SetBool)(words[0] == "on")
    print(json.dumps([answer.success, answer.message]))
elif what == "calibrate":
    rospy.wait_for_service("/rigwake/calibrate", 15)
    answer = rospy.ServiceProxy("/rigwake/calibrate", Trigger)()
    print(json.dumps([answer.success, answer.message]))
elif what == "surround":
    from sensor_msgs.msg import CompressedImage
    found = rospy.wait_for_message("/rigwake/surround/compressed", CompressedImage, timeout=50)
    print(json.dumps([found.header.frame_id, found.header.stamp.to_nsec(), found.format, bytes(found.data).hex()]))
elif what == "tf":
    buffer = tf2_ros.Buffer()
    listener = tf2_ros.TransformListener(buffer)
    t = buffer.lookup_transform(words[0], words[1], rospy.Time(0), rospy.Duration(15)).transform
    print(json.dumps([[t.rotation.w, t.rotation.x, t.rotation.y, t.rotation.z],
                      [t.translation.x, t.translation.y, t.translation.z]]))
"""


def missing() -> str:
    """What is not installed for these tests; empty if nothing."""
    if not Path(SYSTEM_PYTHON).exists() or not Path("/usr/bin/rosmaster").exists():
        return "rosmaster"
    probe = subprocess.run(
        [SYSTEM_PYTHON, "-c", f"import {','.join(WANTED)}"], capture_output=True, check=False
    )
    return "" if probe.returncode == 0 else probe.stderr.decode().strip().splitlines()[-1]


class RosGraph:
    """Processes of one graph; `close` ends them all."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.environment = {
            **os.environ,
            "ROS_MASTER_URI": f"http://127.0.0.1:{self.port}",
            "ROS_IP": "127.0.0.1",
            "ROS_LOG_DIR": str(folder / "log"),
            "ROS_HOME": str(folder / "home"),
            "PYTHONPATH": str(Path(rigwake.__file__).parent.parent),
        }
        self.log = (folder / "ros.txt").open("a")
        self.processes: list[subprocess.Popen[bytes]] = []
        self.start_master()

    def start(self, *words: object, **more: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [str(w) for w in words],
            env={**self.environment, **more},
            stdout=self.log,
            stderr=self.log,
            cwd=self.folder,
            start_new_session=True,
        )
        self.processes.append(process)
        return process

    def start_master(self) -> None:
        self.master = self.start("/usr/bin/rosmaster", "--core", "-p", self.port)
        end = time.monotonic() + 30
        while time.monotonic() < end:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)
        raise TimeoutError((self.folder / "ros.txt").read_text())

    def start_node(self, *words: object) -> subprocess.Popen[bytes]:
        return self.start(sys.executable, "-P", "-m", "rigwake", "ros", "node", *words)

    def play(self, bag: Path, *words: object) -> subprocess.Popen[bytes]:
        return self.start(PLAYER, "--quiet", *words, bag)

    def look(self, *words: str):  # type: ignore[no-untyped-def]
        """What another node sees: `diagnostics`, `record on`, `calibrate`, `tf PARENT CHILD`."""
        done = subprocess.run(
            [SYSTEM_PYTHON, "-c", LOOK, *words],
            env={k: v for k, v in self.environment.items() if k != "PYTHONPATH"},
            capture_output=True,
            timeout=60,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(done.stderr.decode()[-800:] + (self.folder / "ros.txt").read_text()[-1500:])
        return json.loads(done.stdout.decode().splitlines()[-1])

    def end(self, process: subprocess.Popen[bytes]) -> None:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()

    def close(self) -> None:
        for process in reversed(self.processes):
            self.end(process)
        self.log.close()
