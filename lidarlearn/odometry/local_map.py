"""The local map: which registered scans the next one is registered against."""

from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.registration.association.base import Association


class LocalMap:
    """Chooses the scans of the map: the last key frames, or with a size of 1 the previous one (frame-to-frame).

    Args:
        association: holds the scans and searches them.
        size: number of scans in the map.
        key_frame_distance_m: a scan is added once the sensor has moved this far from the last key frame [m]...
        key_frame_angle_deg: ...or turned by this angle [deg]. 0 disables a criterion; with both 0 every scan is
            added.

    Source: Dellenbach et al. 2021, III-A "Local map and neighborhood": k = 30.
    """

    def __init__(
        self,
        association: Association,
        size: int = 30,
        key_frame_distance_m: float = 0.0,
        key_frame_angle_deg: float = 0.0,
    ) -> None:
        if size < 1:
            raise ValueError(f"local_map.size must be at least 1 scan, got {size}")
        self.association = association
        self.size = size
        self._key_frame_distance_m = key_frame_distance_m
        self._key_frame_angle_deg = key_frame_angle_deg
        self._T_world_key: Tensor | None = None

    def update(self, points: Float[Tensor, "n 3"], T_world_lidar: Float[Tensor, "4 4"]) -> None:
        """Add a registered scan, unless it is too close to the last key frame."""
        if self._is_key_frame(T_world_lidar):
            self.association.insert(points, T_world_lidar, self.size)
            self._T_world_key = T_world_lidar

    def restart(self) -> None:
        """Forget every scan."""
        self.association.clear()
        self._T_world_key = None

    def _is_key_frame(self, T_world_lidar: Float[Tensor, "4 4"]) -> bool:
        if self._T_world_key is None or self._key_frame_distance_m == self._key_frame_angle_deg == 0:
            return True
        moved = se3.motion_difference(self._T_world_key, T_world_lidar)
        is_far = moved.distance_m >= self._key_frame_distance_m > 0
        is_turned = moved.angle_deg >= self._key_frame_angle_deg > 0
        return is_far or is_turned
