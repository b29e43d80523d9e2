"""Every export, read by another program's parser, puts a point of the world on the same pixel."""

import csv
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import types
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calibrated_rigs import FISHEYE, PINHOLE, boat
from rigwake.calibration import Calibration
from rigwake.exporters import ExportedImuNoise, ExportOptions, export_calibration

IMU = ExportedImuNoise(0.01, 0.001, 0.002, 0.0001, 200.0, "/imu")
POINT_CAM = np.array([1.3, -0.4, 2.1])  # in front of each camera, and inside its image


def expected(calibration: Calibration, name: str) -> tuple[np.ndarray, np.ndarray]:
    """A world point (rig coordinates) and its pixel."""
    camera = calibration.cameras[name]
    pixel, valid = camera.model.project(POINT_CAM[None])
    assert valid.all()
    return camera.rig_from_cam * POINT_CAM, pixel[0]


def same_geometry(calibration: Calibration, name: str, cam_from_rig: np.ndarray, K, D, fisheye: bool) -> None:
    """The exported matrix is the camera's to 1e-9, and OpenCV finds the point where rigwake finds it."""
    cam_from_rig = np.vstack([cam_from_rig[:3], [0, 0, 0, 1]])
    np.testing.assert_allclose(
        cam_from_rig, calibration.cameras[name].rig_from_cam.inverse().matrix, atol=1e-9
    )
    point_rig, pixel = expected(calibration, name)
    point_cam = (cam_from_rig @ [*point_rig, 1.0])[:3].reshape(1, 1, 3)
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    found = project(point_cam, np.zeros(3), np.zeros(3), np.asarray(K, float), np.asarray(D, float))[0]
    np.testing.assert_allclose(found.ravel(), pixel, atol=1e-6)


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


@pytest.mark.parametrize("lens", [FISHEYE, PINHOLE], ids=["fisheye", "pinhole"])
def test_kalibr(tmp_path: Path, lens) -> None:
    rig = boat(lens=lens)
    assert export_calibration(rig, "kalibr", tmp_path / "camchain.yaml") == []
    chain = yaml.safe_load((tmp_path / "camchain.yaml").read_text())
    assert list(chain) == ["cam0", "cam1", "cam2", "cam3"]
    previous = None
    for entry, name in zip(chain.values(), rig.cameras, strict=True):
        assert entry["camera_model"] == "pinhole"
        assert entry["distortion_model"] == ("equidistant" if lens is FISHEYE else "radtan")
        assert entry["resolution"] == [640, 480]
        assert entry["rostopic"] == f"/cameras/{name}/image_raw"
        assert entry["cam_overlaps"] == []
        assert entry["timeshift_cam_imu"] == 0.0121
        cam_from_imu = np.array(entry["T_cam_imu"])
        assert ("T_cn_cnm1" in entry) == (previous is not None)
        if previous is not None:
            np.testing.assert_allclose(np.array(entry["T_cn_cnm1"]) @ previous, cam_from_imu, atol=1e-9)
        previous = cam_from_imu
        K = camera_matrix(*entry["intrinsics"])
        same_geometry(rig, name, cam_from_imu, K, entry["distortion_coeffs"], lens is FISHEYE)


def test_kalibr_without_imu_is_a_chain_only(tmp_path: Path) -> None:
    rig = boat("base_link")
    (note,) = export_calibration(rig, "kalibr", tmp_path / "camchain.yaml")
    assert "no T_cam_imu" in note
    chain = yaml.safe_load((tmp_path / "camchain.yaml").read_text())
    assert not any(key in entry for entry in chain.values() for key in ("T_cam_imu", "timeshift_cam_imu"))
    port_from_front = rig.cameras["port"].rig_from_cam.inverse() * rig.cameras["front"].rig_from_cam
    np.testing.assert_allclose(chain["cam1"]["T_cn_cnm1"], port_from_front.matrix, atol=1e-9)


def opencv_matrix(node) -> np.ndarray:
    """A list of lists, as OpenVINS reads it."""
    return np.array([[node.at(i).at(j).real() for j in range(4)] for i in range(4)])


def test_openvins_read_by_opencv(tmp_path: Path) -> None:
    rig = boat()
    export_calibration(rig, "openvins", tmp_path / "kalibr_imucam_chain.yaml")
    storage = cv2.FileStorage(str(tmp_path / "kalibr_imucam_chain.yaml"), cv2.FILE_STORAGE_READ)
    for number, name in enumerate(rig.cameras):
        node = storage.getNode(f"cam{number}")
        assert node.getNode("distortion_model").string() == "equidistant"
        assert node.getNode("rostopic").string() == f"/cameras/{name}/image_raw"
        assert node.getNode("timeshift_cam_imu").real() == 0.0121
        K = camera_matrix(*(node.getNode("intrinsics").at(k).real() for k in range(4)))
        D = [node.getNode("distortion_coeffs").at(k).real() for k in range(4)]
        same_geometry(rig, name, np.linalg.inv(opencv_matrix(node.getNode("T_imu_cam"))), K, D, True)
    storage.release()


def test_basalt(tmp_path: Path) -> None:
    rig = boat()
    notes = export_calibration(rig, "basalt", tmp_path / "calibration.json", ExportOptions(imu=IMU))
    assert notes == ["order of the cameras: front, port, starboard, aft"]
    value = json.loads((tmp_path / "calibration.json").read_text())["value0"]
    assert value["cam_time_offset_ns"] == 12_100_000
    assert (value["imu_update_rate"], value["gyro_noise_std"]) == (200.0, [0.002] * 3)
    assert len(value["calib_accel_bias"]) == 9
    assert len(value["calib_gyro_bias"]) == 12
    for name, pose, lens, size in zip(
        rig.cameras, value["T_imu_cam"], value["intrinsics"], value["resolution"], strict=True
    ):
        imu_from_cam = np.eye(4)
        imu_from_cam[:3, :3] = Rotation.from_quat([pose[k] for k in ("qx", "qy", "qz", "qw")]).as_matrix()
        imu_from_cam[:3, 3] = [pose[k] for k in ("px", "py", "pz")]
        assert (lens["camera_type"], size) == ("kb4", [640, 480])
        p = lens["intrinsics"]
        K = camera_matrix(p["fx"], p["fy"], p["cx"], p["cy"])
        same_geometry(rig, name, np.linalg.inv(imu_from_cam), K, [p[f"k{i}"] for i in (1, 2, 3, 4)], True)


def test_camodocal(tmp_path: Path) -> None:
    rig = boat()
    export_calibration(rig, "camodocal", tmp_path)
    lines = (tmp_path / "extrinsic.txt").read_text().splitlines()
    for k, name in enumerate(rig.cameras):
        assert lines[5 * k] == name
        assert lines[5 * k + 4] == ""
        odometry_from_cam = np.vstack([np.loadtxt(lines[5 * k + 1 : 5 * k + 4]), [0, 0, 0, 1]])
        storage = cv2.FileStorage(str(tmp_path / f"{name}_calib.yaml"), cv2.FILE_STORAGE_READ)
        assert storage.getNode("model_type").string() == "KANNALA_BRANDT"
        assert storage.getNode("camera_name").string() == name
        p = storage.getNode("projection_parameters")
        K = camera_matrix(*(p.getNode(key).real() for key in ("mu", "mv", "u0", "v0")))
        D = [p.getNode(key).real() for key in ("k2", "k3", "k4", "k5")]
        same_geometry(rig, name, np.linalg.inv(odometry_from_cam), K, D, True)
        storage.release()


@pytest.mark.parametrize("lens", [FISHEYE, PINHOLE], ids=["fisheye", "pinhole"])
def test_colmap_read_by_pycolmap(tmp_path: Path, lens) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    rig = boat(lens=lens)
    export_calibration(rig, "colmap", tmp_path)
    (config,) = pycolmap.read_rig_config(tmp_path / "rig_config.json")
    first_from_rig = rig.cameras["front"].rig_from_cam.inverse()
    lines = [x.split() for x in (tmp_path / "cameras.txt").read_text().splitlines() if x[0] != "#"]
    assert [sensor.ref_sensor for sensor in config.cameras] == [True, False, False, False]
    for sensor, name, line in zip(config.cameras, rig.cameras, lines, strict=True):
        assert sensor.image_prefix == f"{name}/"
        point_rig, pixel = expected(rig, name)
        point_first = first_from_rig * point_rig
        point_cam = point_first if sensor.ref_sensor else sensor.cam_from_rig * point_first
        np.testing.assert_allclose(np.ravel(point_cam), POINT_CAM, atol=1e-9)
        camera = pycolmap.Camera(
            model=line[1], width=int(line[2]), height=int(line[3]), params=[float(x) for x in line[4:]]
        )
        np.testing.assert_allclose(
            np.ravel(camera.img_from_cam(np.reshape(point_cam, (1, 3)))), pixel + 0.5, atol=1e-6
        )
        np.testing.assert_array_equal(camera.params, sensor.camera.params)


MRCAL = """
import json, sys, mrcal, numpy as np
model = mrcal.cameramodel(sys.argv[1])
point_rig = np.array(json.loads(sys.argv[2]))
point_cam = mrcal.transform_point_rt(model.extrinsics_rt_fromref(), point_rig)
print(json.dumps([point_cam.tolist(), mrcal.project(point_cam, *model.intrinsics()).tolist()]))
"""


def debian(*modules: str) -> str:
    """Debian's Python, if it has these modules; else skip."""
    python = "/usr/bin/python3"
    if (
        not Path(python).exists()
        or subprocess.run(
            [python, "-c", f"import {', '.join(modules)}"], capture_output=True, check=False
        ).returncode
    ):
        pytest.skip(f"Debian's {', '.join(modules)} are not installed")
    return python


def test_mrcal_read_by_mrcal(tmp_path: Path) -> None:
    python = debian("mrcal")
    rig = boat(lens=PINHOLE)
    export_calibration(rig, "mrcal", tmp_path)
    for name in ("front", "aft"):
        point_rig, pixel = expected(rig, name)
        arguments = [str(tmp_path / f"{name}.cameramodel"), json.dumps(point_rig.tolist())]
        answer = subprocess.run(
            [python, "-c", MRCAL, *arguments], capture_output=True, text=True, check=True
        ).stdout
        point_cam, found = json.loads(answer)
        np.testing.assert_allclose(point_cam, POINT_CAM, atol=1e-9)
        np.testing.assert_allclose(found, pixel, atol=1e-6)


@pytest.mark.parametrize("lens", [FISHEYE, PINHOLE], ids=["fisheye", "pinhole"])
def test_opencv_read_by_opencv(tmp_path: Path, lens) -> None:
    rig = boat(lens=lens)
    export_calibration(rig, "opencv", tmp_path)
    for name in rig.cameras:
        storage = cv2.FileStorage(str(tmp_path / f"{name}.yaml"), cv2.FILE_STORAGE_READ)
        K, D = storage.getNode("camera_matrix").mat(), storage.getNode("distortion_coefficients").mat()
        assert storage.getNode("rig_frame").string() == "imu"
        cam_from_rig = np.linalg.inv(storage.getNode("rig_from_cam").mat())
        same_geometry(rig, name, cam_from_rig, K, D, bool(int(storage.getNode("fisheye_model").real())))
        storage.release()


def check_frames(rig: Calibration, found: dict[str, tuple[str, np.ndarray, np.ndarray]]) -> None:
    """`child: (parent, translation, quaternion xyzw)`: parent_from_child carries the point to the rig."""
    assert set(found) == {f"{name}_optical_frame" for name in rig.cameras}
    for name in rig.cameras:
        parent, translation, quat_xyzw = found[f"{name}_optical_frame"]
        assert parent == rig.reference
        point_rig, _ = expected(rig, name)
        np.testing.assert_allclose(
            Rotation.from_quat(quat_xyzw).apply(POINT_CAM) + translation, point_rig, atol=1e-9
        )


def frame(words: list[str]) -> tuple[str, tuple[str, np.ndarray, np.ndarray]]:
    numbers = np.array([float(word) for word in words[:7]])
    return words[8], (words[7], numbers[:3], numbers[3:])


def test_ros1_launch(tmp_path: Path) -> None:
    rig = boat("base_link")
    export_calibration(rig, "ros-static-tf", tmp_path / "cameras.launch")
    nodes = ET.parse(tmp_path / "cameras.launch").getroot().findall("node")
    assert {(node.get("pkg"), node.get("type")) for node in nodes} == {
        ("tf2_ros", "static_transform_publisher")
    }
    check_frames(rig, dict(frame(node.get("args").split()) for node in nodes))


def test_ros2_launch_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With `launch` and `launch_ros` standing in: what the nodes are started with."""
    launch, launch_ros, actions = (
        types.ModuleType(n) for n in ("launch", "launch_ros", "launch_ros.actions")
    )
    launch.LaunchDescription = list
    actions.Node = lambda **fields: fields
    for module in (launch, launch_ros, actions):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    rig = boat("base_link")
    export_calibration(rig, "ros-static-tf", tmp_path / "cameras.launch.py")
    namespace = {}
    exec(compile((tmp_path / "cameras.launch.py").read_text(), "cameras.launch.py", "exec"), namespace)
    nodes = namespace["generate_launch_description"]()
    assert {node["executable"] for node in nodes} == {"static_transform_publisher"}
    options = [dict(zip(n["arguments"][::2], n["arguments"][1::2], strict=True)) for n in nodes]
    flags = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw", "--frame-id", "--child-frame-id")
    check_frames(rig, dict(frame([option[flag] for flag in flags]) for option in options))


TF2 = """
import json, sys, rospy, rosbag, tf2_py
buffer = tf2_py.BufferCore(rospy.Duration(10.0))
for _, message, _ in rosbag.Bag(sys.argv[1]).read_messages(topics=["/tf_static"]):
    for transform in message.transforms:
        buffer.set_transform_static(transform, "bag")
found = {}
for child in sys.argv[3:]:
    t = buffer.lookup_transform_core(sys.argv[2], child, rospy.Time(0)).transform
    p, q = t.translation, t.rotation
    found[child] = [sys.argv[2], [p.x, p.y, p.z], [q.x, q.y, q.z, q.w]]
print(json.dumps(found))
"""


def test_tf_static_bag_in_ros1(tmp_path: Path) -> None:
    """Debian's rosbag reads the bag, Debian's tf2 looks the transforms up."""
    python = debian("rosbag", "tf2_py", "rospy")
    rig = boat("base_link")
    export_calibration(rig, "ros-static-tf", tmp_path / "tf_static.bag")
    frames = [f"{name}_optical_frame" for name in rig.cameras]
    answer = subprocess.run(
        [python, "-c", TF2, str(tmp_path / "tf_static.bag"), "base_link", *frames],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    check_frames(rig, json.loads(answer))


def test_urdf_read_by_urdf_parser(tmp_path: Path) -> None:
    urdf = pytest.importorskip("urdf_parser_py.urdf")
    rig = boat("base_link")
    export_calibration(rig, "urdf", tmp_path / "cameras.urdf")
    robot = urdf.URDF.from_xml_string((tmp_path / "cameras.urdf").read_bytes())
    assert robot.get_root() == "base_link"
    found = {}
    for joint in robot.joints:
        assert joint.type == "fixed"
        quat_xyzw = Rotation.from_euler("xyz", joint.origin.rpy).as_quat()  # fixed axes
        found[joint.child] = (joint.parent, np.array(joint.origin.xyz), quat_xyzw)
    check_frames(rig, found)


def test_xacro_is_a_macro_of_the_same_joints(tmp_path: Path) -> None:
    rig = boat("base_link")
    for name in ("cameras.urdf", "cameras.xacro"):
        export_calibration(rig, "urdf", tmp_path / name)
    macro = ET.parse(tmp_path / "cameras.xacro").getroot().find("{http://www.ros.org/wiki/xacro}macro")
    assert macro.get("params") == "parent:=base_link prefix:=''"
    expanded = (
        ET.tostring(macro, encoding="unicode").replace("${parent}", "base_link").replace("${prefix}", "")
    )
    plain = ET.parse(tmp_path / "cameras.urdf").getroot()
    joints = {j.get("name"): j.find("origin").attrib for j in ET.fromstring(expanded).iter("joint")}
    assert joints == {j.get("name"): j.find("origin").attrib for j in plain.iter("joint")}
    assert len(joints) == 4


def test_csv_and_json(tmp_path: Path) -> None:
    rig = boat()
    export_calibration(rig, "csv", tmp_path / "rig.csv")
    export_calibration(rig, "json", tmp_path / "rig.json")
    with (tmp_path / "rig.csv").open() as file:
        table = list(csv.DictReader(file))
    content = json.loads((tmp_path / "rig.json").read_text())
    for row, name in zip(table, rig.cameras, strict=True):
        point_rig, _ = expected(rig, name)
        position = np.array([float(row[k]) for k in ("x_m", "y_m", "z_m")])
        by_quaternion = Rotation.from_quat([float(row[k]) for k in ("qx", "qy", "qz", "qw")])
        np.testing.assert_allclose(by_quaternion.apply(POINT_CAM) + position, point_rig, atol=1e-9)
        by_angles = Rotation.from_euler(
            "ZYX", [float(row[k]) for k in ("yaw_deg", "pitch_deg", "roll_deg")], degrees=True
        )
        np.testing.assert_allclose(by_angles.apply(POINT_CAM) + position, point_rig, atol=1e-9)
        assert float(row["std_z_m"]) == pytest.approx(rig.cameras[name].std_translation_m[2])
        transform = content["cameras"][name]["rig_from_cam"]
        assert transform["translation_m"] == position.tolist()


LISTEN = """
import json, sys, rospy, tf2_ros
rospy.init_node("listener", anonymous=True)
buffer = tf2_ros.Buffer()
listener = tf2_ros.TransformListener(buffer)
found = {}
for child in sys.argv[2:]:
    t = buffer.lookup_transform(sys.argv[1], child, rospy.Time(0), rospy.Duration(20)).transform
    p, q = t.translation, t.rotation
    found[child] = [sys.argv[1], [p.x, p.y, p.z], [q.x, q.y, q.z, q.w]]
print(json.dumps(found))
"""


@pytest.mark.slow
def test_launched_in_ros1(tmp_path: Path) -> None:
    """Debian's roslaunch starts the file, a tf2 listener receives the transforms."""
    python = debian("rospy", "roslaunch", "tf2_ros")
    roslaunch = shutil.which("roslaunch")
    if roslaunch is None or not Path("/usr/lib/tf2_ros/static_transform_publisher").exists():
        pytest.skip("Debian's roslaunch and tf2_ros are not installed")
    rig = boat("base_link")
    export_calibration(rig, "ros-static-tf", tmp_path / "cameras.launch")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    master = {"ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1"}
    environment = {**os.environ, **master, "ROS_HOME": str(tmp_path), "ROS_LOG_DIR": str(tmp_path)}
    command = [python, roslaunch, "-p", str(port), str(tmp_path / "cameras.launch")]
    frames = [f"{name}_optical_frame" for name in rig.cameras]
    with (tmp_path / "launch.log").open("w") as log:
        launched = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        try:
            wait_for(port, launched)
            answer = subprocess.run(
                [python, "-c", LISTEN, "base_link", *frames],
                env=environment,
                capture_output=True,
                text=True,
                check=True,
                timeout=60,
            ).stdout
        finally:
            launched.send_signal(signal.SIGINT)
            launched.wait(30)
    check_frames(rig, json.loads(answer.splitlines()[-1]))


def wait_for(port: int, process: subprocess.Popen) -> None:
    """Until somebody listens at the port."""
    for _ in range(300):
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        assert process.poll() is None, "roslaunch ended"
        time.sleep(0.1)
    raise AssertionError("the ROS master did not start")
