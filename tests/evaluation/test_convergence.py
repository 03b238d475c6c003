"""Basins of convergence."""

from types import SimpleNamespace

import pytest
import torch

from lidarlearn.evaluation.convergence import Probe, basin_tables, convergence_basin
from lidarlearn.geometry import se3
from lidarlearn.odometry import Backend, GridSampling, LocalMap
from lidarlearn.registration.association import KdTree
from lidarlearn.registration.gauss_newton import GaussNewton
from tests.box_world import BoxSequence

PROBE = Probe(offsets_m=(0.1, 20.0), angles_deg=(1.0, 170.0), directions=2, every=4, min_range_m=0.5)


def basin(drive):
    return convergence_basin(Backend(GridSampling(), LocalMap(KdTree())), drive, PROBE)


def test_basin_is_relative_to_registration_from_ground_truth():
    exact, rough = BoxSequence("0", 6), BoxSequence("0", 6)
    rough.T_world_lidar = rough.T_world_lidar.clone()
    rough.T_world_lidar[4, 1, 3] += 0.3
    for drive, off_m in ((exact, 0.0), (rough, 0.3)):
        measured = basin(drive)
        assert measured.scans == 1
        assert measured.by_offset_m == {0.1: 1.0, 20.0: 0.0}
        assert measured.by_angle_deg[1.0] == 1.0 and measured.by_angle_deg[170.0] < 1
        assert measured.from_truth_m == pytest.approx(off_m, abs=0.02)
        assert measured.from_truth_deg < 0.2


class Stay(GaussNewton):
    """Returns the initial poses, and records its arguments."""

    def register(self, points, association, T_initial, search_distance_m, normals):
        self.points, self.T_initial = points, T_initial
        return SimpleNamespace(T_world_lidar=T_initial)


def test_basin_probes_offsets_and_angles_about_true_pose():
    drive, stay = BoxSequence("0", 6), Stay()
    probe = Probe(offsets_m=(1.0,), angles_deg=(10.0,), directions=2, every=4, min_range_m=3.0, max_range_m=8.0)
    measured = convergence_basin(Backend(GridSampling(), LocalMap(KdTree()), stay), drive, probe)
    off = torch.zeros(5, 6, dtype=torch.float64)
    off[1:3, 0], off[3:, 5] = torch.tensor([1.0, -1.0]), torch.tensor([10.0, -10.0]).deg2rad()
    torch.testing.assert_close(se3.to_euler(se3.inverse(drive.T_world_lidar[4]) @ stay.T_initial), off)
    assert 3 <= stay.points.norm(dim=1).min() and stay.points.norm(dim=1).max() <= 8
    assert measured.by_offset_m == {1.0: 0.0} and measured.by_angle_deg == {10.0: 0.0}


def test_basin_tables_show_error_of_registration_from_truth():
    rows = [table.rows for table in basin_tables({"kd_f2m": basin(BoxSequence("0", 6))})]
    assert rows[0] == (("kd_f2m", "100", "0"),)
    ((name, metres, degrees),) = rows[-1]
    assert name == "kd_f2m" and float(metres) < 0.02 and float(degrees) < 0.2
