"""KITTI raw's files."""

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from lidarlearn.data.export.exporter import PERIOD_S, Exporter, timestamps_of, write_shared
from lidarlearn.data.export.kitti import write_velodyne_scans
from lidarlearn.data.kitti_raw import KittiRaw
from lidarlearn.data.oxts import EARTH_RADIUS_M, write_timestamps
from lidarlearn.data.pose_files import euler_from_transforms
from lidarlearn.data.sequence import Sequence
from lidarlearn.errors import UserError
from lidarlearn.geometry import se3

_LEVER_ARM_M = torch.tensor([-0.81, 0.32, -0.80])  # of KITTI's GPS/IMU, in the LiDAR's frame
_START_DEG = (49.0, 8.4)  # latitude and longitude of Karlsruhe
_START_ALTITUDE_M = 115.0


class KittiRawExporter(Exporter[KittiRaw]):
    """Writes scans, start and end times, GPS/IMU packets at the middle of each sweep, and their calibration.

    Packets hold position, orientation and velocity; accelerations, rates and accuracies are zero.
    """

    option = "kitti_raw"
    places = ("*/{}_sync",)

    def require(self, drive: Sequence, name: str) -> None:
        """Point times follow from azimuths, scans have poses, and the name is a drive's."""
        self.require_sweeps(drive)
        self.ground_truth(drive)
        if not name.partition("_drive_")[2]:
            raise UserError(
                f"{self.target.title}: {name!r} does not name a drive.\n  change: a name like 2011_09_26_drive_0009"
            )

    def write(self, drive: Sequence, name: str) -> None:
        """Write calibration, scans, times and packets."""
        date = name.partition("_drive_")[0]
        folder = self.target.root / date / f"{name.removesuffix('_sync')}_sync"
        translation = " ".join(f"{value:.6e}" for value in _LEVER_ARM_M.tolist())
        calibration = f"calib_time: 01-Jan-2011 00:00:00\nR: 1 0 0 0 1 0 0 0 1\nT: {translation}\n"
        write_shared(folder.parent / "calib_imu_to_velo.txt", calibration)
        velodyne, oxts = folder / "velodyne_points", folder / "oxts"
        write_velodyne_scans(velodyne / "data", self.scans(drive, name), digits=10)
        (oxts / "data").mkdir(parents=True, exist_ok=True)
        day, middles = np.datetime64(date.replace("_", "-"), "ns"), timestamps_of(drive)
        write_timestamps(velodyne / "timestamps_start.txt", day, middles - PERIOD_S / 2)
        write_timestamps(velodyne / "timestamps.txt", day, middles)
        write_timestamps(velodyne / "timestamps_end.txt", day, middles + PERIOD_S / 2)
        write_timestamps(oxts / "timestamps.txt", day, middles)
        T_lidar_imu = se3.from_rotation_translation(torch.eye(3, dtype=torch.float64), _LEVER_ARM_M.double())
        for index, row in enumerate(_packets(self.ground_truth(drive) @ T_lidar_imu, middles.numpy())):
            text = " ".join(f"{value:.14g}" for value in row)
            (oxts / "data" / f"{index:010d}.txt").write_text(text + "\n", encoding="utf-8")


def _packets(T_world_imu: Float[Tensor, "n 4 4"], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """30 numbers for each pose: see `dataformat.txt` of KITTI raw. The inverse of `oxts.read_oxts_poses`."""
    latitude_0, longitude_0 = np.radians(_START_DEG)
    scale = np.cos(latitude_0) * EARTH_RADIUS_M
    R, position = T_world_imu[:, :3, :3].numpy(), T_world_imu[:, :3, 3].numpy()
    x, y, z = (position - position[0]).T
    north_0 = np.log(np.tan(np.pi / 4 + latitude_0 / 2))
    latitude = 2 * np.arctan(np.exp(north_0 + y / scale)) - np.pi / 2
    packets = np.zeros((len(times), 30))
    packets[:, 0] = np.degrees(latitude)
    packets[:, 1] = np.degrees(longitude_0 + x / scale)
    packets[:, 2] = _START_ALTITUDE_M + z
    packets[:, 3:6] = euler_from_transforms(T_world_imu)
    if len(times) > 1:
        velocity = np.gradient(position, times, axis=0)
        packets[:, 6], packets[:, 7] = velocity[:, 1], velocity[:, 0]  # north, east
        packets[:, 8:11] = (velocity[:, None] @ R)[:, 0]  # forward, left, up
    return packets
