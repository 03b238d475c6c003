"""Errors on real scans stay within the bounds that the project promises."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from torch import Tensor

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.cloud_files import read_cloud
from lidarlearn.data.pose_files import as_transforms, read_kitti_poses
from lidarlearn.data.sequence import Scan, Sequence
from lidarlearn.geometry import se3
from lidarlearn.metrics.absolute import ape_rmse
from lidarlearn.odometry.base import Frame
from tests.odometry.odometries import ASSOCIATIONS, build, composed, motion_errors, poses, run, run_with_times

pytestmark = pytest.mark.realdata
all_associations = pytest.mark.parametrize("association", ASSOCIATIONS)


@cache
def opened(data: str, root: Path, name: str) -> tuple[Sequence, tuple[Scan, ...]]:
    sequence = instantiate(composed(f"data={data}", f"data.root={root}").data).sequence(name)
    return sequence, tuple(sequence)


@cache
def cloud(path: Path) -> Tensor:
    return read_cloud(path).points


def assert_no_failure(frames: list[Frame], true: Tensor) -> None:
    """No motion off by more than 1 m or 3 deg, as the paper defines it, and no flagged frame."""
    translations, angles = motion_errors(poses(frames), true)
    assert translations.max() < 1 and angles.max() < 3
    assert not any(frame.health.flagged for frame in frames)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("association", "mean_rpe_m", "ape_m"), [("kd", 0.016, 0.030), ("vh", 0.016, 0.030), ("p", 0.018, 0.045)]
)
def test_errors_on_kitti_04(real_data, association, mean_rpe_m, ape_m, record_property):
    """All three measure 1.36 cm. KISS-ICP 1.3.0 on the same scans: mean RPE 2.2 cm, APE 0.026 m.

    As published, two of five of these scans are skewed by 9 cm from beginning to end; rigid ones give 1.8 and 1.6 cm.
    """
    sequence, scans = opened("kitti_00-08", real_data / "kitti_odometry", "04")
    true = sequence.T_world_lidar[: len(scans)]
    frames = run(build(f"cv+{association}_f2m"), [scan.points for scan in scans])
    translations, _ = motion_errors(poses(frames), true)
    record_property("mean_rpe_m", translations.mean().item())
    record_property("ape_rmse_m", ape_rmse(poses(frames), true))
    assert len(frames) == 51
    assert_no_failure(frames, true)
    assert translations.mean() <= mean_rpe_m
    assert ape_rmse(poses(frames), true) <= ape_m
    assert translations[:5].max() < 0.05  # from the first frame on


@pytest.mark.slow
@pytest.mark.parametrize(
    ("association", "residual", "weight"),
    [
        ("kd", "point_to_point", "geman_mcclure"),
        ("kd", "generalized_icp", "geman_mcclure"),
        ("vh", "generalized_icp", "geman_mcclure"),
        ("p", "generalized_icp", "proximity"),
    ],
)
def test_errors_of_other_residuals_on_kitti_04(real_data, association, residual, weight, record_property):
    sequence, scans = opened("kitti_00-08", real_data / "kitti_odometry", "04")
    scans, true = scans[:12], sequence.T_world_lidar[:12]
    name = f"{association}_f2m"
    registration = f"odometry.{name}.registration"
    odometry = build(
        f"cv+{name}", f"residual@{registration}.residual={residual}", f"weight@{registration}.weight={weight}"
    )
    frames = run(odometry, [scan.points for scan in scans])
    translations, _ = motion_errors(poses(frames), true)
    record_property("mean_rpe_m", translations.mean().item())
    assert_no_failure(frames, true)
    assert translations.mean() < 0.05 and translations[:3].max() < 0.1


@pytest.mark.slow
@all_associations
def test_deskewing_improves_fit_on_kitti_raw_0009(real_data, association, record_property):
    """The errors say less: GPS and IMU are 2 cm a scan aside of the scans' motion and jump by 3 cm.

    Kd and VH measure 2.39 cm against 2.42 of skewed scans, lower by 0.0 to 0.3 mm with other lots for the points of
    voxels. That deskewing lowers the error, where the truth is known exactly, is tested in test_deskew.py.
    """
    sequence, scans = opened("kitti_raw", real_data / "kitti_raw", "2011_09_26_drive_0009")
    true = sequence.T_world_lidar[: len(scans)]
    with_times, without = build(f"cv+{association}_f2m"), build(f"cv+{association}_f2m")
    deskewed = run_with_times(with_times, scans)
    skewed = run(without, [scan.points for scan in scans])
    assert len(scans) == 31
    assert_no_failure(deskewed, true)
    errors, skewed_errors = (motion_errors(poses(frames), true)[0] for frames in (deskewed, skewed))
    record_property("mean_rpe_m", [errors.mean().item(), skewed_errors.mean().item()])
    assert errors.mean() < 0.03
    assert errors.mean() < skewed_errors.mean()
    rmse, skewed_rmse = (sum(frame.health.rmse_m for frame in frames[1:]) for frames in (deskewed, skewed))
    assert rmse < 0.99 * skewed_rmse


def pair_errors(
    association: str, projection: str, reference: Tensor, new: Tensor, true: Tensor, *overrides: str
) -> tuple[float, float]:
    """Errors [m], [deg] of one motion, registered from the identity and nothing else."""
    odometry = build(f"ni+{association}_f2m", "pipeline.recovery=false", *overrides, projection=projection)
    frames = run(odometry, [reference, new])
    assert not frames[1].health.flagged and frames[1].health.converged
    translations, angles = motion_errors(poses(frames), torch.stack([se3.identity(), true]))
    return translations.item(), angles.item()


@pytest.mark.parametrize("pair", [(94, 95), (198, 199)])
@all_associations
def test_errors_on_turning_pairs_of_kitti_00(real_data, association, pair):
    calibration = (real_data / "kitti_pairs/00/calib.txt").read_text().splitlines()
    row = next(line for line in calibration if line.startswith("Tr:")).split()[1:]
    T_camera_lidar = as_transforms(torch.tensor([float(x) for x in row], dtype=torch.float64).view(3, 4))
    T_world_camera = read_kitti_poses(real_data / "kitti_odometry/poses/00.txt")[list(pair)]
    T_world_lidar = T_world_camera @ T_camera_lidar
    true = se3.orthonormalize(torch.linalg.solve(T_world_lidar[0], T_world_lidar[1]))
    scans = [raise_beams(cloud(real_data / f"kitti_pairs/00/{i:06d}.bin"), 0.205) for i in pair]
    distance, angle = pair_errors(association, "hdl64", *scans, true)
    assert distance < 0.03 and angle < 0.2


@all_associations
def test_errors_on_pair_of_hdl_32(real_data, association):
    """Measured: 1.1-1.4 cm and 0.25-0.27 deg, in roll, and the same in all associations, forwards and backwards.

    The truth that comes with the pair is itself a registration: small_gicp's GICP on a grid of 0.1 m returns it to
    0.001 deg, on one of 0.25 m it is 0.33 deg off. Our grids from 0.1 to 0.4 m are 0.25 to 0.30 deg off, that of 0.8 m,
    which a drive with 32 beams needs, 0.5 deg and 3.2-3.5 cm.
    """
    folder = real_data / "hdl32_pair"
    true = se3.orthonormalize(as_transforms(torch.from_numpy(np.loadtxt(folder / "T_target_source.txt"))[:3]))
    scans = [cloud(folder / f"{name}.ply") for name in ("target", "source")]
    grid = [f"odometry.{a}_f2m.sampling.map_voxel_m=0.4" for a in ("kd", "vh")]
    distance, angle = pair_errors(association, "hdl32", *scans, true, *grid)
    assert distance < 0.03 and angle < 0.35


@pytest.mark.parametrize("first", [0, 1])
@all_associations
def test_errors_on_neighbouring_ouster_scans(real_data, association, first):
    """Ground truth is of a frame whose y and z are opposite to the points', at instants 10 ms from the scans'."""
    rows = np.loadtxt(real_data / "ouster_mcd/mcd_kth_smoke_gt.csv", delimiter=",", skiprows=1)
    T_lidar_pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    true = T_lidar_pose @ se3.relative(se3.from_euler(torch.from_numpy(rows[:, 1:])))[first] @ T_lidar_pose
    scans = [cloud(real_data / f"ouster_mcd/{i}.pcd") for i in (first, first + 1)]
    distance, angle = pair_errors(association, "os1_64", *scans, true)
    assert distance < 0.05 and angle < 0.4


@all_associations
def test_scan_of_nclt_registers_with_its_moved_copy(real_data, association):
    points = opened("nclt", real_data / "nclt", "2012-01-15")[1][0].points
    true = se3.exp(torch.tensor([0.15, -0.05, 0.03, 0.005, 0.01, 0.025], dtype=torch.float64))
    new = se3.transform(se3.inverse(true), points)
    distance, angle = pair_errors(association, "hdl32_inverted", points, new, true)
    assert distance < 0.02 and angle < 0.1
