"""Miniature data sets in the genuine on-disk formats, with the truth that went into them.

Written from the formats' descriptions with numpy and scipy alone, so that a reader is never tested against itself; the
containers of ROS bags by the library that writes and reads them for others.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

# A camera's axes (x right, y down, z forward) in those of a LiDAR, and a lever arm: what calib.txt calls Tr.
T_CAMERA_LIDAR = np.array([[0, -1, 0, 0.01], [0, 0, -1, -0.07], [1, 0, 0, -0.27], [0, 0, 0, 1]], dtype=np.float64)

RECORDED_EVERY_NS = 100_000_000  # messages of a topic of a bag


@dataclass(frozen=True)
class Written:
    """What a reader should find: points (n, 3) of each scan and poses of the LiDAR relative to the first one."""

    points: list[np.ndarray]
    T_world_lidar: np.ndarray


def curve(frames: int) -> np.ndarray:
    """Poses along a climbing left turn with some roll, 1 m and 3 deg a frame, (frames, 4, 4)."""
    twist = np.array([[0, -0.05, 0.01, 1.0], [0.05, 0, -0.02, 0.1], [-0.01, 0.02, 0, 0.05], [0, 0, 0, 0]])
    step = expm(twist)
    return np.stack([np.linalg.matrix_power(step, i) for i in range(frames)])


def relative_to_first(poses: np.ndarray) -> np.ndarray:
    return np.linalg.inv(poses[0]) @ poses


def random_points(seed: int, count: int = 200, closest: float = 2.0) -> np.ndarray:
    """Points all around at 2 to 60 m, (count, 3)."""
    rng = np.random.default_rng(seed)
    azimuth, ranges = rng.uniform(-np.pi, np.pi, count), rng.uniform(closest, 60, count)
    elevation = np.radians(rng.uniform(-10, 10, count))
    xyz = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    return (np.stack(xyz, axis=1) * ranges[:, None]).astype(np.float32)


def write_float32(path: Path, points: np.ndarray, columns: int = 4) -> None:
    """x, y, z, reflectance 0.5 and zeros, as float32 rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.zeros((len(points), columns), dtype="<f4")
    rows[:, :3] = points
    if columns > 3:
        rows[:, 3] = 0.5
    path.write_bytes(rows.tobytes())


def kitti_rows(poses: np.ndarray) -> str:
    return "".join(" ".join(f"{v:.12e}" for v in pose[:3].reshape(-1)) + "\n" for pose in poses)


def tum_rows(poses: np.ndarray, times: Iterable[float]) -> str:
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = np.concatenate([np.asarray(times)[:, None], poses[:, :3, 3], quaternions], axis=1)
    return "# time tx ty tz qx qy qz qw\n" + "".join(" ".join(f"{v:.12f}" for v in row) + "\n" for row in rows)


def write_kitti_odometry(root: Path, name: str = "04", frames: int = 5) -> Written:
    folder = root / "sequences" / name
    points = [random_points(i) for i in range(frames)]
    for i, scan in enumerate(points):
        write_float32(folder / "velodyne" / f"{i:06d}.bin", scan)
    tr = " ".join(f"{v:.12e}" for v in T_CAMERA_LIDAR[:3].reshape(-1))
    (folder / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: " + tr + "\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * i:.6e}\n" for i in range(frames)))
    T_world_camera = T_CAMERA_LIDAR @ curve(frames) @ np.linalg.inv(T_CAMERA_LIDAR)
    (root / "poses").mkdir(exist_ok=True)
    (root / "poses" / f"{name}.txt").write_text(kitti_rows(T_world_camera))
    return Written(points, curve(frames))


def write_kitti_raw(
    root: Path, drive: str = "2011_09_26_drive_0009", frames: int = 6, dropped: tuple[int, ...] = (), lag: float = 0.01
) -> Written:
    """KITTI raw; scans in `dropped` are missing as in the genuine drive 0009, GPS/IMU packets come `lag` s later."""
    date = root / drive[:10]
    folder = date / f"{drive}_sync"
    (folder / "oxts" / "data").mkdir(parents=True)
    (folder / "velodyne_points" / "data").mkdir(parents=True)
    numbers = [i for i in range(frames) if i not in dropped]
    points = [random_points(i) for i in numbers]
    for i, scan in zip(numbers, points, strict=True):
        write_float32(folder / "velodyne_points" / "data" / f"{i:010d}.bin", scan)
    start = datetime(2011, 9, 26, 13, 8, 24)
    for name, offset in (("start", -0.05), ("end", 0.05)):
        lines = ["" if i in dropped else _stamp(start, 0.1 * i + offset) for i in range(frames)]
        (folder / "velodyne_points" / f"timestamps_{name}.txt").write_text("\n".join(lines) + "\n")
    (folder / "oxts" / "timestamps.txt").write_text("".join(_stamp(start, 0.1 * i + lag) + "\n" for i in range(frames)))
    T_lidar_imu = np.eye(4)
    T_lidar_imu[:3, 3] = -0.81, 0.32, -0.8
    (date / "calib_imu_to_velo.txt").write_text("calib_time: x\nR: 1 0 0 0 1 0 0 0 1\nT: -0.81 0.32 -0.8\n")
    # The packets see the same curve as the LiDAR, `lag` later; a constant twist makes that exact.
    T_lag = expm(lag / 0.1 * np.real(logm(curve(2)[1])))
    for i, T in enumerate(curve(frames) @ T_lag @ T_lidar_imu):
        (folder / "oxts" / "data" / f"{i:010d}.txt").write_text(_oxts_packet(T))
    return Written(points, relative_to_first(curve(frames)[numbers]))


def _stamp(start: datetime, seconds: float) -> str:
    # nanoseconds as in the genuine files
    return (start + timedelta(seconds=seconds)).strftime("%Y-%m-%d %H:%M:%S.%f") + "000"


def _oxts_packet(T_world_imu: np.ndarray) -> str:
    """A packet near 49 N, 8.4 E: the Mercator projection with the scale of the first latitude, inverted."""
    radius, latitude_0 = 6378137.0, np.radians(49.0)
    scale = np.cos(latitude_0) * radius
    x, y, z = T_world_imu[:3, 3]
    north_0 = np.log(np.tan(np.pi / 4 + latitude_0 / 2))
    latitude = np.degrees(2 * np.arctan(np.exp(north_0 + y / scale)) - np.pi / 2)
    longitude = 8.4 + np.degrees(x / scale)
    yaw, pitch, roll = Rotation.from_matrix(T_world_imu[:3, :3]).as_euler("ZYX")
    first = [latitude, longitude, 115 + z, roll, pitch, yaw]
    return " ".join(f"{v:.14f}" for v in first) + " 0" * 24 + "\n"


def write_kitti_360(root: Path, name: str = "0003", frames: int = 6, without_pose: tuple[int, ...] = ()) -> Written:
    """KITTI-360; its GPS/IMU looks forward, right and down, its poses begin 1000 m from the origin."""
    drive = f"2013_05_28_drive_{name}_sync"
    velodyne, poses = root / "data_3d_raw" / drive / "velodyne_points", root / "data_poses" / drive
    points = [random_points(i) for i in range(frames)]
    for i, scan in enumerate(points):
        write_float32(velodyne / "data" / f"{i:010d}.bin", scan)
    start = datetime(2013, 5, 28, 8, 46, 2)
    (velodyne / "timestamps.txt").write_text("".join(_stamp(start, 0.1 * i) + "\n" for i in range(frames)))
    T_imu_lidar = np.diag([1.0, -1.0, -1.0, 1.0])
    T_imu_lidar[:3, 3] = 0.8, 0.3, -0.9
    T_imu_camera = T_imu_lidar @ np.linalg.inv(T_CAMERA_LIDAR)
    (root / "calibration").mkdir()
    row = kitti_rows(T_imu_camera[None])
    (root / "calibration" / "calib_cam_to_pose.txt").write_text(f"image_00: {row}image_01: {row}")
    (root / "calibration" / "calib_cam_to_velo.txt").write_text(kitti_rows(np.linalg.inv(T_CAMERA_LIDAR)[None]))
    T_world_imu = curve(frames) @ np.linalg.inv(T_imu_lidar)
    T_world_imu[:, :3, 3] += 1000
    poses.mkdir(parents=True)
    lines = kitti_rows(T_world_imu).splitlines()
    rows = [f"{i} {line}\n" for i, line in enumerate(lines) if i not in without_pose]
    (poses / "poses.txt").write_text("".join(rows))
    return Written(points, curve(frames))


def write_newer_college(root: Path, name: str = "01_short_experiment", frames: int = 4) -> Written:
    """Newer College; of each scan's 1024 x 64 places every 300th holds a return."""
    scans, truth = root / name / "raw_format" / "ouster_scan", root / name / "ground_truth"
    scans.mkdir(parents=True)
    truth.mkdir()
    places, points = np.arange(0, 1024 * 64, 300), []
    start_ns = 1583836591_950_000_000  # the second changes on the way, and nanoseconds lose digits
    header = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1024\nHEIGHT 64\n"
        "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 65536\nDATA binary\n"
    )
    for i in range(frames):
        grid = np.zeros((1024 * 64, 3), dtype="<f4")
        grid[places] = random_points(i, len(places))
        points.append(grid[places])
        seconds, nanoseconds = divmod(start_ns + 100_000_000 * i, 10**9)
        (scans / f"cloud_{seconds}_{nanoseconds}.pcd").write_bytes(header.encode() + grid.tobytes())
    half = expm(np.real(logm(curve(2)[1])) / 2)
    T_camera_lidar = np.eye(4)
    T_camera_lidar[:3, :3] = Rotation.from_quat([0, 0, 0.924, 0.383]).as_matrix()
    T_camera_lidar[:3, 3] = -0.084, -0.025, 0.05
    lines = ["#sec,nsec,x,y,z,qx,qy,qz,qw"]
    for k in range(2 * frames + 2):  # every 50 ms from 50 ms before the first middle of a sweep
        T = np.linalg.matrix_power(half, k) @ np.linalg.inv(T_camera_lidar)
        numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        seconds, nanoseconds = divmod(start_ns + 50_000_000 * k, 10**9)
        lines.append(f"{seconds},{nanoseconds}," + ",".join(f"{v:.12f}" for v in numbers))
    (truth / "registered_poses.csv").write_text("\n".join(lines) + "\n")
    return Written(points, curve(frames))


def write_nclt(root: Path, date: str = "2012-01-08", frames: int = 5, sensor_height_m: float = 1.03) -> Written:
    """NCLT; ground truth every 10 ms inside the date's folder, its first row NaN as in the genuine files."""
    folder = root / date / "velodyne_sync"
    folder.mkdir(parents=True)
    first_us, flip = 1326030975726043, np.diag([1.0, -1.0, -1.0, 1.0])
    points = []
    for i in range(frames):
        files_xyz = (random_points(i) + np.array([0, 0, sensor_height_m])) * [1, -1, -1]
        files_xyz[0, 0] = 80.0  # beyond what a signed reading could hold
        steps = np.round((files_xyz + 100) / 0.005).astype("<u2")
        rows = np.zeros(len(steps), dtype=[("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
        rows["xyz"], rows["intensity"], rows["laser"] = steps, 51, np.arange(len(steps)) % 32
        (folder / f"{first_us + 100_000 * i}.bin").write_bytes(rows.tobytes())
        points.append((steps * 0.005 - 100) * [1, -1, -1] - [0, 0, sensor_height_m])
    T_files_lidar = flip.copy()
    T_files_lidar[2, 3] = -sensor_height_m
    tenth = expm(np.real(logm(curve(2)[1])) / 10)
    lines = [f"{first_us - 1000}, nan, nan, nan, nan, nan, nan"]
    for k in range(10 * frames):
        T = flip @ np.linalg.matrix_power(tenth, k) @ np.linalg.inv(T_files_lidar)
        yaw, pitch, roll = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX")
        values = ", ".join(f"{v:.12f}" for v in (*T[:3, 3], roll, pitch, yaw))
        lines.append(f"{first_us + 10_000 * k}, {values}")
    (root / date / f"groundtruth_{date}.csv").write_text("\n".join(lines) + "\n")
    return Written(points, curve(frames))


def write_ford_campus(root: Path, name: str = "IJRR-Dataset-1", frames: int = 4) -> Written:
    """Ford Campus; one return in each scan is at 5 m, on the truck itself."""
    folder = root / name / "SCANS"
    folder.mkdir(parents=True)
    points = [random_points(i, closest=9.0) for i in range(frames)]
    for i, (scan, T) in enumerate(zip(points, curve(frames), strict=True)):
        x, y, z = np.concatenate([scan, [[5.0, 0.0, -1.0]]]).T.astype(np.float64)
        yaw, pitch, roll = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX")
        content = {
            "XYZ": np.stack([-y, x, z]),
            "X_wv": np.array([*T[:3, 3], roll, pitch, yaw]).reshape(6, 1),
            "timestamp_laser": np.array([[1.26e15 + 1e5 * i]]),
            "image_index": np.array([[i]]),
        }
        savemat(folder / f"Scan{i + 75:04d}.mat", {"SCAN": content}, do_compression=True)
    return Written(points, curve(frames))


def as_rows(points: np.ndarray, fields: list[tuple[str, str]] | np.dtype, **values: np.ndarray | float) -> np.ndarray:
    """Points as a driver lays them out: a structured array of x, y, z and other fields."""
    rows = np.zeros(points.shape[:-1], dtype=fields)
    rows["x"], rows["y"], rows["z"] = np.moveaxis(points, -1, 0)
    for name, value in values.items():
        rows[name] = value
    return rows


def write_bag(
    root: Path,
    name: str,
    topics: dict[str, list[np.ndarray] | list[str]],
    kind: str = "ros1",
    stamps: np.ndarray | None = None,
    compression: str | None = None,
    row_padding: int = 0,
    start_s: float = 1.6e9,
) -> Path:
    """A bag by the writers of `rosbags`, with PointCloud2 messages for rows of points and String for text.

    Args:
        root: the folder in which it is written.
        name: of the file or folder.
        topics: messages at 10 Hz, recorded 3 ms after their stamps.
        kind: ros1, sqlite3 or mcap.
        stamps: times in the headers [s]; None for 10 Hz from `start_s` on.
        compression: bz2 or lz4 of ROS 1, FILE, MESSAGE or STORAGE of ROS 2.
        row_padding: bytes between the rows of a cloud.
        start_s: time of the first message.
    """
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    root.mkdir(parents=True, exist_ok=True)
    if kind == "ros1":
        path, serialize = root / f"{name}.bag", types.serialize_ros1
        writer = rosbag1.Writer(path)
        if compression:
            writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
    else:
        path, serialize = root / name, types.serialize_cdr
        writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[kind.upper()])
        if compression:
            writer.set_compression(rosbag2.CompressionMode[compression], rosbag2.CompressionFormat.ZSTD)
    with writer:
        for topic, messages in topics.items():
            text = bool(messages) and isinstance(messages[0], str)
            message_type = "std_msgs/msg/String" if text else "sensor_msgs/msg/PointCloud2"
            connection = writer.add_connection(topic, message_type, typestore=types)
            for i, content in enumerate(messages):
                recorded_ns = round(1e9 * start_s) + RECORDED_EVERY_NS * i + 3_000_000
                stamp_ns = round(1e9 * start_s) + 100_000_000 * i if stamps is None else round(1e9 * stamps[i])
                message = (
                    types.types[message_type](data=content) if text else _cloud(types, content, stamp_ns, row_padding)
                )
                writer.write(connection, recorded_ns, serialize(message, message_type))
    return path


def _cloud(types: Any, rows: np.ndarray, stamp_ns: int, row_padding: int) -> Any:
    numbers = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    field, header = types.types["sensor_msgs/msg/PointField"], types.types["std_msgs/msg/Header"]
    layout = [(name, *rows.dtype.fields[name][:2]) for name in rows.dtype.names]
    rows = np.atleast_2d(rows)
    height, width = rows.shape
    buffer = np.zeros((height, width * rows.itemsize + row_padding), np.uint8)
    buffer[:, : width * rows.itemsize] = np.ascontiguousarray(rows).view(np.uint8).reshape(height, -1)
    stamp = types.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    sequence_number = {"seq": 0} if "seq" in header.__dataclass_fields__ else {}
    return types.types["sensor_msgs/msg/PointCloud2"](
        header=header(stamp=stamp, frame_id="lidar", **sequence_number),
        height=height,
        width=width,
        fields=[field(name, offset, numbers[dtype.str[1:]], 1) for name, dtype, offset in layout],
        is_bigendian=any(dtype.str[0] == ">" for _, dtype, _ in layout),
        point_step=rows.itemsize,
        row_step=buffer.shape[1],
        data=buffer.reshape(-1),
        is_dense=False,
    )


def write_pcd(path: Path, points: np.ndarray, times: np.ndarray, encoding: str = "binary") -> None:
    """A .pcd file as Ouster's tools write it: x, y, z, intensity as float32 and t as uint32 [ns]."""
    rows = np.zeros(len(points), dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4")])
    rows["x"], rows["y"], rows["z"] = points.T
    rows["intensity"], rows["t"] = 100.0, times
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity t\nSIZE 4 4 4 4 4\n"
        f"TYPE F F F F U\nCOUNT 1 1 1 1 1\nWIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\n"
        f"DATA {encoding}\n"
    )
    if encoding == "ascii":
        lines = [f"{r['x']:.9g} {r['y']:.9g} {r['z']:.9g} {r['intensity']:.9g} {r['t']}" for r in rows]
        path.write_text(header + "\n".join(lines) + "\n")
    elif encoding == "binary":
        path.write_bytes(header.encode() + rows.tobytes())
    else:
        columns = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names or ())
        packed = lzf_literals(columns)
        sizes = np.array([len(packed), len(columns)], dtype="<u4").tobytes()
        path.write_bytes(header.encode() + sizes + packed)


def lzf_literals(data: bytes) -> bytes:
    """LZF without back references: runs of up to 32 bytes behind their length less one."""
    runs = (data[i : i + 32] for i in range(0, len(data), 32))
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def write_ply(path: Path, points: np.ndarray, times: np.ndarray, encoding: str = "binary_little_endian") -> None:
    """A .ply file with float x, y, z, scalar_intensity and double time."""
    header = (
        f"ply\nformat {encoding} 1.0\ncomment written for a test\nelement vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\nproperty float scalar_intensity\nproperty double time\n"
        "end_header\n"
    )
    if encoding == "ascii":
        lines = [" ".join(f"{v:.9g}" for v in p) + f" 100 {t:.17g}" for p, t in zip(points, times, strict=True)]
        path.write_text(header + "\n".join(lines) + "\n")
        return
    order = "<" if encoding.endswith("little_endian") else ">"
    fields = [("x", f"{order}f4"), ("y", f"{order}f4"), ("z", f"{order}f4"), ("i", f"{order}f4"), ("t", f"{order}f8")]
    rows = np.zeros(len(points), dtype=fields)
    rows["x"], rows["y"], rows["z"] = points.T
    rows["i"], rows["t"] = 100.0, times
    path.write_bytes(header.encode() + rows.tobytes())
