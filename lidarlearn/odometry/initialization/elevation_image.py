"""EI: planar motion from features of two elevation images."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.odometry.initialization.base import Initialization, InitialMotion
from lidarlearn.odometry.initialization.constant_velocity import ConstantVelocity


@dataclass(frozen=True)
class _Features:
    positions_m: Float[np.ndarray, "n 2"]  # x and y in the sensor's frame
    descriptors: np.ndarray | None


class ElevationImage(Initialization):
    """Registers bird's-eye images of the heights above the sensor by ORB features and a robust homography.

    Binary descriptors are matched by Hamming distance with a cross check. The homography only decides which matches
    are inliers; the motion is the planar rigid motion that fits them best.

    Args:
        size_px: edge of the square image [px].
        pixel_m: edge of a pixel [m].
        max_height_m: heights above the sensor are mapped from 0..max_height_m to 1..255 grey values [m].
        features: ORB features per image.
        inlier_threshold_m: distance up to which a match agrees with the homography [m].
        min_inliers: with fewer inliers, constant velocity is used instead.

    Source: Dellenbach et al. 2021, III-A "Initialization": 800x800 px of 0.30 m, N_I = 100 inliers.
    """

    def __init__(
        self,
        size_px: int = 800,
        pixel_m: float = 0.30,
        max_height_m: float = 10.0,
        features: int = 2000,
        inlier_threshold_m: float = 0.6,
        min_inliers: int = 100,
    ) -> None:
        self._size_px = size_px
        self._pixel_m = pixel_m
        self._max_height_m = max_height_m
        self._inlier_threshold_m = inlier_threshold_m
        self._min_inliers = min_inliers
        self._orb = cv2.ORB.create(nfeatures=features, fastThreshold=5)
        self._matcher = cv2.BFMatcher.create(cv2.NORM_HAMMING, crossCheck=True)
        self._fallback = ConstantVelocity()
        self._previous: _Features | None = None

    def predict(self, points: Float[Tensor, "n 3"], last_motion: Float[Tensor, "4 4"]) -> InitialMotion:
        """The planar motion between the last two images, or constant velocity where they do not match."""
        previous, new = self._previous, self._features(points)
        self._previous = new
        motion = None if previous is None else self._planar_motion(previous, new)
        if motion is None:
            return self._fallback.predict(points, last_motion)
        return InitialMotion(motion, "ei")

    def image(self, points: Float[Tensor, "n 3"]) -> np.ndarray:
        """Grey image (size_px, size_px) of the greatest height above the sensor in each cell, 0 where there is none."""
        above = points[points[:, 2] > 0]
        cell = (above[:, :2] / self._pixel_m + self._size_px / 2).floor().long()
        inside = ((cell >= 0) & (cell < self._size_px)).all(dim=1)
        grey = (1 + above[inside, 2] * (254 / self._max_height_m)).clamp(max=255)
        image = torch.zeros(self._size_px * self._size_px, device=points.device)
        image.scatter_reduce_(0, cell[inside, 1] * self._size_px + cell[inside, 0], grey, "amax")
        return image.view(self._size_px, self._size_px).byte().cpu().numpy()

    def _features(self, points: Tensor) -> _Features:
        keypoints, descriptors = self._orb.detectAndCompute(self.image(points), None)
        pixels = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2)
        return _Features((pixels + 0.5 - self._size_px / 2) * self._pixel_m, descriptors)

    def _planar_motion(self, previous: _Features, new: _Features) -> Tensor | None:
        if previous.descriptors is None or new.descriptors is None:
            return None
        matches = self._matcher.match(new.descriptors, previous.descriptors)
        if len(matches) < max(self._min_inliers, 4):
            return None
        source = new.positions_m[[m.queryIdx for m in matches]]
        target = previous.positions_m[[m.trainIdx for m in matches]]
        _, inliers = cv2.findHomography(source, target, cv2.RANSAC, self._inlier_threshold_m)
        used = inliers.ravel().astype(bool) if inliers is not None else np.zeros(len(matches), bool)
        if used.sum() < self._min_inliers:
            return None
        return _rigid_fit(source[used], target[used])


def _rigid_fit(source: Float[np.ndarray, "n 2"], target: Float[np.ndarray, "n 2"]) -> Float[Tensor, "4 4"]:
    """Least-squares rotation about z and translation in the plane, as T_target_source."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    t = target.mean(axis=0) - R @ source.mean(axis=0)
    return se3.from_euler(torch.tensor([t[0], t[1], 0, 0, 0, yaw], dtype=torch.float64))
