"""Basins of convergence."""

import pytest

from lidarlearn.evaluation.convergence import Probe, basin_tables, convergence_basin
from lidarlearn.odometry import Backend, GridSampling, LocalMap
from lidarlearn.registration.association import KdTree
from tests.box_world import BoxSequence

PROBE = Probe(offsets_m=(0.1, 20.0), angles_deg=(1.0, 170.0), directions=2, every=4, min_range_m=0.5)


def basin(drive):
    return convergence_basin(Backend(GridSampling(), LocalMap(KdTree())), drive, PROBE)


def test_a_registration_succeeds_where_the_one_from_the_truth_ends_however_good_the_truth_is():
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


def test_where_the_one_from_the_truth_ends_is_printed():
    rows = [table.rows for table in basin_tables({"kd_f2m": basin(BoxSequence("0", 6))})]
    assert rows[0] == (("kd_f2m", "100", "0"),)
    ((name, metres, degrees),) = rows[-1]
    assert name == "kd_f2m" and float(metres) < 0.02 and float(degrees) < 0.2
