import math

import pytest
import torch
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.odometry.local_map import LocalMap
from lidarlearn.registration.association import KdTree


def pose(x: float, yaw_deg: float = 0.0) -> Tensor:
    return se3.from_euler(torch.tensor([x, 0, 0, 0, 0, math.radians(yaw_deg)], dtype=torch.float64))


class Recorder(KdTree):
    """Records the poses and window sizes of insertions."""

    def __init__(self) -> None:
        super().__init__()
        self.inserted: list[tuple[float, int]] = []

    def insert(self, points: Tensor, T_world_lidar: Tensor, frames: int) -> None:
        super().insert(points, T_world_lidar, frames)
        self.inserted.append((T_world_lidar[0, 3].item(), frames))


POINT = torch.tensor([[5.0, 0.0, 0.0]])


def test_every_scan_is_added_and_window_slides():
    searchable = Recorder()
    local_map = LocalMap(searchable, size=3)
    for i in range(6):
        local_map.update(POINT, pose(10.0 * i))
    assert searchable.inserted == [(10.0 * i, 3) for i in range(6)]
    found = searchable.search(POINT + torch.tensor([[10.0 * i, 0, 0] for i in range(6)]), 0.1)
    assert found.mask.tolist() == [False, False, False, True, True, True]


def test_map_of_size_one_holds_previous_scan():
    local_map = LocalMap(Recorder(), size=1)
    local_map.update(POINT, pose(0.0))
    local_map.update(POINT, pose(10.0))
    assert local_map.association.search(POINT, 1.0).mask.tolist() == [False]
    assert local_map.association.search(POINT + torch.tensor([10.0, 0, 0]), 1.0).mask.tolist() == [True]


def test_key_frames_by_distance_or_angle_since_last():
    searchable = Recorder()
    local_map = LocalMap(searchable, key_frame_distance_m=1.0, key_frame_angle_deg=10.0)
    for x, yaw in [(0.0, 0.0), (0.6, 0.0), (0.9, 9.0), (1.1, 0.0), (1.2, 12.0), (1.3, 3.0), (1.3, 1.0)]:
        local_map.update(POINT, pose(x, yaw))
    assert [x for x, _ in searchable.inserted] == [0.0, 1.1, 1.2, 1.3]


@pytest.mark.parametrize(
    ("setting", "kept"),
    [({"key_frame_distance_m": 1.0}, [0.0, 1.1, 2.2]), ({"key_frame_angle_deg": 10.0}, [0.0, 1.2])],
)
def test_key_frames_by_distance_or_angle_alone(setting, kept):
    searchable = Recorder()
    local_map = LocalMap(searchable, **setting)
    for x, yaw in [(0.0, 0.0), (0.6, 0.0), (1.1, 9.0), (1.2, 12.0), (2.2, 12.0)]:
        local_map.update(POINT, pose(x, yaw))
    assert [x for x, _ in searchable.inserted] == kept


def test_restarted_map_takes_next_scan_as_key_frame():
    searchable = Recorder()
    local_map = LocalMap(searchable, key_frame_distance_m=100.0, key_frame_angle_deg=100.0)
    local_map.update(POINT, pose(0.0))
    local_map.restart()
    assert searchable.is_empty
    local_map.update(POINT, pose(1.0))
    assert [x for x, _ in searchable.inserted] == [0.0, 1.0]


def test_map_size_of_zero_is_refused():
    with pytest.raises(ValueError, match=r"local_map\.size must be at least 1"):
        LocalMap(KdTree(), size=0)
