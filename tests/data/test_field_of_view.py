"""Whether scans fit the projection of their sensor."""

import pytest
import torch
from hydra.utils import instantiate

from lidarlearn.commands.data import compose_data_set
from lidarlearn.data.field_of_view import field_of_view_warning
from lidarlearn.data.folder import Folder
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.simulation import sensors
from tests.box_world import SMALL, BoxDrives
from tests.commands.configs import option_nodes, options

SENSORS = {
    "hdl64": sensors.hdl64(64),
    "hdl32": sensors.hdl32(64),
    "hdl32_inverted": sensors.hdl32_inverted(64),
    "vlp16": sensors.vlp16(64),
    "os1_64": sensors.os1_64(64),
}


def projection(name):
    return instantiate(option_nodes("data", "projection")["projection", name])


@pytest.mark.parametrize("name", SENSORS)
def test_sensor_fits_its_own_projection(name):
    points = torch.from_numpy(SENSORS[name].directions(0).reshape(-1, 3) * 20)
    assert field_of_view_warning("drive", points, projection(name)) is None


def test_warning_states_field_of_view_and_projections():
    points = torch.from_numpy(sensors.os1_64(64).directions(0).reshape(-1, 3) * 20)
    points = torch.cat([points, torch.zeros(9000, 3)])  # points without a return are not counted
    remark = field_of_view_warning("drive", points, projection("hdl64"))
    assert remark is not None
    assert "44 % of the points of drive's first scan" in remark and "+3 to -24 deg" in remark
    assert "from +21 to -21 deg" in remark and all(name in remark for name in options("projection"))


def test_sequences_warn_once(caplog):
    data = BoxDrives(frames=3)
    assert list(data.sequences(["0", "1"])) == ["0", "1"] and not caplog.records
    data.projection = SphericalProjection(SMALL.height, SMALL.width, fov_up_deg=2.0, fov_down_deg=-20.0)
    data.sequences(["0", "1"])
    assert len(caplog.records) == 1 and "of 0's first scan" in caplog.text


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("data", "root", "sequence"),
    [
        (["data=kitti_00-08"], "kitti_odometry", "04"),
        (["data=kitti_raw"], "kitti_raw", "2011_09_26_drive_0009"),
        (["data=nclt"], "nclt", "2012-01-15"),
        (["data=folder"], "kitti_pairs", "00"),
        (["data=folder", "projection@data.projection=os1_64"], "ouster_mcd", "ouster_mcd"),
        (["data=folder", "projection@data.projection=hdl32"], "hdl32_pair", "hdl32_pair"),
    ],
    ids=["kitti", "kitti_raw", "nclt", "kitti_pairs", "os1_64", "hdl32"],
)
def test_genuine_scans_fit_projections_of_their_sensors(real_data, data, root, sequence):
    data_set = compose_data_set([*data, f"data.root={real_data / root}"])
    points = data_set.sequence(sequence).scan(0).points
    assert field_of_view_warning(sequence, points, data_set.projection) is None


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["ouster_mcd", "hdl32_pair"])
def test_check_reports_genuine_scans_outside_projection(real_data, name):
    data = Folder(real_data / name, SphericalProjection())
    odd = " ".join(finding.detail for finding in data.check().findings if finding.level == "odd")
    assert data.check().usable and "lie outside the image" in odd
