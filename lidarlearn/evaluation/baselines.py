"""Odometries of other projects, run and scored like our own. Each needs its package installed."""

import importlib
from types import ModuleType

import numpy as np
import torch

from lidarlearn.errors import UserError
from lidarlearn.geometry import se3
from lidarlearn.odometry.base import BaseOdometry, Frame, Points, Times, as_scan
from lidarlearn.odometry.health import Health


class KissIcp(BaseOdometry):
    """KISS-ICP.

    Args:
        min_range_m: closer returns are dropped [m].
        max_range_m: farther returns are dropped [m].
        voxel_size_m: voxel size of its map [m]; None takes a hundredth of `max_range_m`.

    Source: Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 2023.
    """

    def __init__(self, min_range_m: float = 0.0, max_range_m: float = 100.0, voxel_size_m: float | None = None) -> None:
        _required("kiss_icp", "kiss-icp")
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP

        config = load_config(None)
        config.data.min_range, config.data.max_range = min_range_m, max_range_m
        config.mapping.voxel_size = voxel_size_m or max_range_m / 100
        config.data.deskew = True  # has no effect on scans without times
        self._odometry = KissICP(config)
        self._frames = 0

    def register_scan(self, points: Points, times: Times | None = None) -> Frame:
        """The pose at the instant to which the times are relative. Scans without times are not deskewed."""
        points, times = as_scan(points, times)
        used = points.isfinite().all(dim=1)
        stamps = torch.zeros(0) if times is None else times[used]
        self._odometry.register_frame(points[used].double().cpu().numpy(), stamps.double().cpu().numpy())
        T_world_lidar = torch.from_numpy(self._odometry.last_pose.copy())
        if len(stamps):  # KISS-ICP deskews to the time of the last point
            motion = se3.log(torch.from_numpy(self._odometry.last_delta.copy()))
            T_world_lidar = se3.orthonormalize(T_world_lidar @ se3.exp(-stamps.max().item() * motion))
        health = Health(self._frames, initialization="kiss_icp", points=int(used.sum()))
        self._frames += 1
        return Frame(T_world_lidar, health)


class SmallGicp(BaseOdometry):
    """small_gicp: generalized ICP against an incremental voxel map, initialized by constant velocity. No deskewing.

    Args:
        voxel_size_m: voxel size of the map [m].
        sampling_m: voxel size to which scans are downsampled [m].
        search_distance_m: largest distance between corresponding points [m].
        threads: number of threads.

    Source: Koide, "small_gicp: Efficient and parallel algorithms for point cloud registration", JOSS 2024.
    """

    def __init__(
        self, voxel_size_m: float = 1.0, sampling_m: float = 0.25, search_distance_m: float = 1.0, threads: int = 2
    ) -> None:
        self._library = _required("small_gicp", "small_gicp")
        self._map = self._library.GaussianVoxelMap(voxel_size_m)
        self._map.set_lru(horizon=100, clear_cycle=10)
        self._sampling_m, self._search_distance_m, self._threads = sampling_m, search_distance_m, threads
        self._T_world_lidar, self._motion = np.eye(4), np.eye(4)
        self._frames = 0

    def register_scan(self, points: Points, times: Times | None = None) -> Frame:
        """The pose of the scan; times are ignored. For a scan without points, the last motion is repeated."""
        points, times = as_scan(points, times)
        used = points[points.isfinite().all(dim=1)].double().cpu().numpy()
        guess = self._T_world_lidar @ self._motion
        if len(used):
            cloud, _ = self._library.preprocess_points(used, self._sampling_m, num_threads=self._threads)
            if self._map.size():
                result = self._library.align(
                    self._map,
                    cloud,
                    guess,
                    max_correspondence_distance=self._search_distance_m,
                    num_threads=self._threads,
                )
                guess = result.T_target_source
            self._map.insert(cloud, guess)
        self._motion = np.linalg.inv(self._T_world_lidar) @ guess
        self._T_world_lidar = guess
        health = Health(self._frames, initialization="small_gicp", points=len(used))
        self._frames += 1
        return Frame(torch.from_numpy(guess.copy()), health)


def _required(module: str, package: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise UserError(
            f"methods: {module} needs the package {package}.\n  change: pip install {package}, or leave it out"
        ) from error
