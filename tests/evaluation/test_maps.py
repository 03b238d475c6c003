"""Maps of drives through closed-form worlds: positions of surfaces, contents, sharpness."""

from functools import cache

import meshio
import pytest
import torch

from lidarlearn.data.cloud_files import read_cloud
from lidarlearn.data.sequence import Scan
from lidarlearn.errors import UserError
from lidarlearn.evaluation.maps import MapSettings, build_map, mean_plane_variance, moments
from lidarlearn.geometry import se3
from lidarlearn.geometry.voxels import voxel_cells
from lidarlearn.simulation import raycasting
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import hdl64
from tests import scenes
from tests.evaluation.conftest import DriveWithoutScans

FRAMES = 8


@cache
def corridor() -> Drive:
    """9 m/s between walls at y = -4 m and 4 m, 1.73 m above the floor, turning; scans are distorted."""
    path = scenes.straight_path(FRAMES + 2, 0.9, yaw_step=0.03)
    return Drive(scenes.corridor(), poses=path, frames=FRAMES, sensor=hdl64(256), motion_distortion=True)


def to_surface(points):
    _, y, z = points.unbind(1)
    return torch.stack([(y - 4).abs(), (y + 4).abs(), (z + scenes.SENSOR_HEIGHT).abs()]).amin(0)


class Standing(DriveWithoutScans):
    """A sensor that does not move; its scans repeat."""

    def __init__(self, frames: int, *scans: Scan):
        super().__init__("standing", se3.identity(frames), frames)
        self.scans = scans

    def scan(self, index: int) -> Scan:
        return self.scans[index % len(self.scans)]


def standing_map(sequence, **settings):
    return build_map(sequence, sequence.T_world_lidar, MapSettings(**settings))


def test_map_places_walls_and_floor():
    drive, advanced = corridor(), []
    built = build_map(drive, drive.T_world_lidar, MapSettings(max_range_m=30.0), True, lambda: advanced.append(1))
    assert len(built.points) > 5000 and len(advanced) == FRAMES
    assert to_surface(built.points).quantile(0.99) < 0.06 and to_surface(built.points).mean() < 0.02
    assert built.extent_m[1] == pytest.approx(8, abs=0.2)


def test_map_deskews_if_requested():
    drive = corridor()
    deskewed, skewed = (
        build_map(drive, drive.T_world_lidar, MapSettings(max_range_m=30.0), on) for on in (True, False)
    )
    assert to_surface(skewed.points).mean() > 3 * to_surface(deskewed.points).mean()


def test_map_has_one_point_per_voxel():
    drive = corridor()
    built = build_map(drive, drive.T_world_lidar, MapSettings(voxel_size_m=0.5, max_range_m=30.0))
    cells = voxel_cells(built.points.double(), 0.5)
    assert len(cells.unique(dim=0)) == len(cells) > 500


def test_voxel_point_is_mean_position_and_intensity():
    points = torch.tensor([[5.1, 0.1, 0.3], [5.3, 0.3, 0.1], [-7.2, 0.2, 0.2]])
    built = standing_map(Standing(1, Scan(points, None, torch.tensor([0.2, 0.6, 0.9]))), voxel_size_m=0.5)
    torch.testing.assert_close(built.points, torch.tensor([[-7.2, 0.2, 0.2], [5.2, 0.2, 0.2]]))
    torch.testing.assert_close(built.intensities, torch.tensor([0.9, 0.4]))


@pytest.mark.parametrize("order", [(0, 1), (1, 0)], ids=["first", "last"])
def test_map_drops_intensities_that_some_scans_lack(order):
    points = torch.full((4, 3), 5.0)
    scans = (Scan(points, None, torch.ones(4)), Scan(points))
    assert standing_map(Standing(2, *(scans[i] for i in order))).intensities is None


def test_repeated_scans_do_not_grow_the_map():
    scan = corridor().scan(0)
    once, often = (standing_map(Standing(frames, scan)) for frames in (1, 20))
    torch.testing.assert_close(once.points, often.points)


def test_map_uses_points_in_range_of_every_nth_scan():
    near, far = (Scan(torch.tensor([[x, 0.0, 0.0], [1.0, 0, 0], [90.0, 0, 0]])) for x in (5.0, 9.0))
    torch.testing.assert_close(standing_map(Standing(4, near, far), every=2).points, torch.tensor([[5.0, 0, 0]]))
    assert len(standing_map(Standing(4, near, far), min_range_m=0.0, max_range_m=100.0).points) == 4


def test_map_refuses_empty_scans_and_wrong_number_of_poses():
    sequence = Standing(3, Scan(torch.ones(5, 3)))
    with pytest.raises(UserError, match="no point between"):
        standing_map(sequence)
    with pytest.raises(UserError, match="2 poses for 3 scans"):
        build_map(sequence, se3.identity(2), MapSettings())


@pytest.mark.parametrize(
    ("setting", "remedy"),
    [({"voxel_size_m": 0.0}, "--voxel"), ({"voxel_size_m": float("nan")}, "--voxel"), ({"every": 0}, "--every"),
     ({"min_range_m": 70.0}, "--min-range"), ({"max_range_m": 1.0}, "--max-range")],
)  # fmt: skip
def test_map_settings_refuse_invalid_values(setting, remedy):
    with pytest.raises(UserError, match=remedy):
        MapSettings(**setting)


@pytest.mark.parametrize("intensities", [None, torch.tensor([0.25, 0.75])], ids=["xyz", "intensity"])
def test_ply_file_is_read_by_meshio_and_open3d(tmp_path, intensities):
    points = torch.tensor([[-7.25, 1.5, 0.125], [5.0, 0.25, 2.5]])
    path = tmp_path / "new" / "a.ply"
    standing_map(Standing(1, Scan(points, None, intensities))).write(path)
    assert path.read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")
    cloud, mesh = read_cloud(path), meshio.read(path)
    torch.testing.assert_close(cloud.points, points)
    assert mesh.points.dtype == "float32" and list(mesh.point_data) == ["intensity"] * (intensities is not None)
    by_open3d = raycasting._open3d().t.io.read_point_cloud(str(path)).point
    torch.testing.assert_close(torch.from_numpy(by_open3d.positions.numpy()), points)
    if intensities is not None:
        assert cloud.intensities.tolist() == by_open3d.intensity.numpy()[:, 0].tolist() == intensities.tolist()


def test_mean_plane_variance_is_noise_variance():
    generator, sigma = torch.Generator().manual_seed(0), 0.02
    sums = []
    for normal in torch.randn(50, 3, generator=generator, dtype=torch.float64):
        plane = torch.rand(2000, 3, generator=generator, dtype=torch.float64) - 0.5
        plane[:, 2] = sigma * torch.randn(2000, generator=generator, dtype=torch.float64)
        turned = plane @ se3.exp(torch.cat([torch.zeros(3), normal]).double())[:3, :3].mT
        sums.append(moments(turned + normal).sum(0))
    assert mean_plane_variance(torch.stack(sums)) == pytest.approx(sigma**2, rel=0.02)
    assert mean_plane_variance(moments(torch.rand(9, 3)).sum(0)[None]) is None


def test_mean_plane_variance_grows_with_pose_errors():
    drive = Drive(scenes.street(), poses=scenes.straight_path(8, 0.9), frames=8, sensor=hdl64(256))
    noise = torch.randn(8, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    noise[:, 3:] /= 20
    variances = [
        build_map(drive, drive.T_world_lidar @ se3.exp(scale * noise), MapSettings()).mean_plane_variance_m2
        for scale in (0.0, 0.02, 0.05, 0.1)
    ]
    assert variances == sorted(variances) and variances[-1] > 1.5 * variances[0]
