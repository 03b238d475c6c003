"""Times of the clouds of a bag, and their poses by the ground truth beside it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarlearn.data.bag_files import Bag, find_bags
from lidarlearn.data.errors import DamagedFileError
from tests.data.bags import KINDS, OUSTER, PLAIN, TIMES_NS, first_x, plain_clouds, rosbag
from tests.data.datasets import findings
from tests.data.writers import as_rows, curve, kitti_rows, random_points, tum_rows, write_bag


@pytest.mark.parametrize("kind", KINDS)
def test_tum_ground_truth_is_interpolated_at_header_stamps(tmp_path, kind):
    write_bag(tmp_path, "street", {"/points": plain_clouds(3)}, kind, stamps=np.array([0.2, 0.5, 0.8]))
    (tmp_path / "street.tum").write_text(tum_rows(curve(6), 0.2 * np.arange(6)))
    sequence = rosbag(tmp_path).sequence("street")
    two_steps = np.linalg.inv(curve(3)[1]) @ curve(5)[4]  # from 0.2 s to 0.8 s
    assert np.allclose(sequence.T_world_lidar[2], two_steps, atol=1e-8)
    assert np.allclose(sequence.timestamps, [0.2, 0.5, 0.8])
    assert "street.tum with" in findings(rosbag(tmp_path).check(), "found")


def pose_at(time):
    """50 m straight ahead at 10 m/s, then a left turn with a radius of 15 m."""
    metres, arc = 10 * time, max(10 * time - 50, 0) / 15
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", arc).as_matrix()
    T[:3, 3] = [min(metres, 50) + 15 * np.sin(arc), 15 * (1 - np.cos(arc)), 0]
    return T


@pytest.mark.parametrize(
    ("field", "kind", "unit", "first"),  # of the points' times; the first [s] relative to the stamp
    [
        ("t", "<u4", 1e9, 0.0),
        ("time", "<f4", 1, 0.0),
        ("time", "<f4", 1, -0.1),  # Velodyne's driver stamps the last point
        ("offset_time", "<u4", 1e6, 0.0),
        ("timestamp", "<f8", 1, None),  # as of 1970
    ],
)
def test_poses_are_at_middle_of_sweep(tmp_path, field, kind, unit, first):
    starts = 1000.0 + 0.1 * np.arange(70)
    shares = np.linspace(0, 0.1, 200)
    rows = [
        as_rows(random_points(0), [*PLAIN, (field, kind)], **{field: (shares + (s if first is None else first)) * unit})
        for s in starts
    ]
    write_bag(tmp_path, "street", {"/points": rows}, stamps=starts if first is None else starts - first)
    times = 0.02 * np.arange(360)
    (tmp_path / "street.tum").write_text(tum_rows(np.stack([pose_at(t) for t in times]), 1000 + times))
    sequence = rosbag(tmp_path).sequence("street")
    assert np.allclose(sequence.timestamps, starts + 0.05, rtol=0, atol=1e-3)
    truth = np.stack([pose_at(t + 0.05) for t in starts - 1000])
    assert np.abs(sequence.T_world_lidar.numpy() - np.linalg.inv(truth[0]) @ truth).max() < 0.01


@pytest.mark.parametrize(("field", "kind", "unit"), [("t", "<u4", 1e9), ("time", "<f8", 1)])
@pytest.mark.parametrize("period", [0.1, 0.05])
def test_point_times_are_shares_of_scan_period(tmp_path, field, kind, unit, period):
    """A sensor may be configured to a part of the full circle."""
    seen = np.linspace(0.25, 0.75, 200) * period
    rows = [as_rows(random_points(0), [*PLAIN, (field, kind)], **{field: seen * unit})] * 4
    write_bag(tmp_path, "street", {"/points": rows}, stamps=1000 + period * np.arange(4))
    sequence = rosbag(tmp_path, deskew=True).sequence("street")
    assert np.allclose(sequence.scan(2).times, np.linspace(-0.25, 0.25, 200), atol=1e-5)
    assert np.allclose(sequence.timestamps, 1000 + period * (np.arange(4) + 0.5), rtol=0, atol=1e-6)


@pytest.mark.parametrize("longest", [1.0, 9999.0])
def test_point_times_of_unknown_unit_span_whole_sweep(tmp_path, longest):
    """The times may be shares of the sweep, or ticks of 10 us."""
    rows = [as_rows(random_points(0), [*PLAIN, ("time", "<f4")], time=np.linspace(0, longest, 200))] * 3
    write_bag(tmp_path, "street", {"/points": rows})
    assert np.allclose(rosbag(tmp_path).sequence("street").scan(1).times, np.linspace(-0.5, 0.5, 200), atol=1e-5)


@pytest.mark.parametrize("odd", [0.0, np.nan])
def test_points_without_valid_time_are_dropped(tmp_path, odd):
    rows, stamps = [], 1.6e9 + 0.1 * np.arange(5)
    for i, stamp in enumerate(stamps):
        times = stamp + np.linspace(0, 0.099, 200)
        if np.isnan(odd) or i != 2:  # the unit is determined from the middle cloud
            times[7] = odd
        rows.append(as_rows(random_points(0), [*PLAIN, ("timestamp", "<f8")], timestamp=times))
    write_bag(tmp_path, "street", {"/points": rows}, stamps=stamps)
    sequence = rosbag(tmp_path).sequence("street")
    assert np.allclose(sequence.timestamps, stamps + 0.0495, rtol=0, atol=1e-5)
    scan = sequence.scan(3)
    assert np.allclose(scan.times, np.delete(np.linspace(-0.495, 0.495, 200), 7), atol=1e-5)
    assert np.array_equal(scan.points, np.delete(random_points(0), 7, axis=0))


def test_recording_times_mark_end_of_sweep(tmp_path):
    rows = [as_rows(random_points(0), OUSTER, t=TIMES_NS)] * 3
    write_bag(tmp_path, "street", {"/points": rows}, stamps=np.zeros(3))
    expected = 1.6e9 + 0.003 - 0.0495 + 0.1 * np.arange(3)
    (tmp_path / "street.tum").write_text(tum_rows(curve(3), 1.6e9 + np.arange(3)))
    assert np.allclose(rosbag(tmp_path).sequence("street").timestamps, expected, rtol=0, atol=1e-6)
    assert rosbag(tmp_path).check().usable


@pytest.mark.parametrize("kind", KINDS)
def test_scans_outside_ground_truth_are_dropped(tmp_path, kind, caplog):
    write_bag(tmp_path, "street", {"/points": plain_clouds(10)}, kind, stamps=0.1 + 0.1 * np.arange(10))
    truth = tmp_path / "street.tum"
    truth.write_text(tum_rows(curve(3), [0.41, 0.5, 0.61]))  # 0.1 s more on either side are covered
    sequence = rosbag(tmp_path).sequence("street")
    assert [first_x(sequence, i) for i in range(4)] == [float(random_points(i)[0, 0]) for i in range(3, 7)]
    assert len(sequence) == len(sequence.T_world_lidar) == len(sequence.timestamps) == 4
    assert "street: 6 scans before or after the ground truth are left out" in caplog.text
    assert rosbag(tmp_path, max_frames=2).sequence("street").timestamps.tolist() == pytest.approx([0.4, 0.5])
    report = rosbag(tmp_path).check()
    assert report.usable
    assert "from 0.410 to 0.610 s, of scans from 0.100 to 1.000 s: those outside are left" in findings(report, "odd")
    truth.write_text(tum_rows(curve(3), [0.1, 0.2, 0.3]))
    assert "those outside are left" in findings(rosbag(tmp_path).check(), "odd")
    for times in ([5, 6, 7], [-7, -6, -5]):
        truth.write_text(tum_rows(curve(3), times))
        with pytest.raises(DamagedFileError, match=r"do not overlap(.|\n)*the same clock"):
            rosbag(tmp_path).sequence("street")
        report = rosbag(tmp_path).check()
        assert not report.usable and "use one clock" in findings(report, "missing")


@pytest.mark.parametrize("kind", KINDS)
def test_last_cloud_is_found_before_end_of_other_topics(tmp_path, kind):
    write_bag(tmp_path, "street", {"/points": plain_clouds(12), "/chatter": ["hello"] * 200}, kind)
    write_bag(tmp_path, "short", {"/points": plain_clouds(1), "/chatter": ["hello"]}, kind)
    for name, last in (("street", 1.1), ("short", 0)):
        (first_ns, _), (last_ns, message) = Bag(find_bags(tmp_path)[name]).ends("/points")
        assert message.header.stamp.nanosec == round(1e9 * (last % 1))
        assert last_ns - first_ns == pytest.approx(1e9 * last)


def test_split_bag_may_have_parts_without_clouds(tmp_path):
    write_bag(tmp_path / "street", "a", {"/chatter": ["hello"] * 2})
    write_bag(tmp_path / "street", "b", {"/points": plain_clouds(2)}, start_s=1.6e9 + 0.3)
    write_bag(tmp_path / "street", "c", {"/chatter": ["hello"] * 2}, start_s=1.6e9 + 0.6)
    assert len(rosbag(tmp_path).sequence("street")) == 2
    assert len(Bag(tmp_path / "street").ends("/points")) == 2


def test_kitti_ground_truth_is_cut_to_max_frames(tmp_path):
    path = write_bag(tmp_path, "street", {"/points": plain_clouds(3)}, "sqlite3")
    (path / "poses.txt").write_text(kitti_rows(curve(3)))
    assert np.allclose(rosbag(tmp_path).sequence("street").T_world_lidar, curve(3))
    cut = rosbag(tmp_path, max_frames=2).sequence("street")
    assert len(cut) == len(cut.T_world_lidar) == len(cut.timestamps) == 2
    for there in (2, 4):
        (path / "poses.txt").write_text(kitti_rows(curve(there)))
        with pytest.raises(DamagedFileError, match=f"{there} poses for 3 scans"):
            rosbag(tmp_path).sequence("street")
        assert f"{there} poses for 3 messages" in findings(rosbag(tmp_path).check(), "odd")


@pytest.mark.parametrize("stamps", [[0, 0, 0], [2, 1, 3]], ids=str)
def test_recording_times_replace_unusable_header_stamps(tmp_path, stamps, caplog):
    write_bag(tmp_path, "street", {"/points": plain_clouds(3)}, stamps=np.array(stamps))
    timestamps = rosbag(tmp_path).sequence("street").timestamps
    assert np.allclose(timestamps, 1.6e9 + 0.003 + 0.1 * np.arange(3), rtol=0, atol=1e-6)
    assert "do not ascend" in caplog.text


@pytest.mark.parametrize(
    ("stamps", "left_out"),
    [
        ({7: 6}, {6, 7}),
        ({7: 8, 8: 7}, {7, 8}),
        ({0: 10**6}, {0}),
        ({12: -5000}, {12}),
    ],
    ids=["repeated", "swapped", "first too late", "zero"],
)
def test_cloud_with_stamp_out_of_order_is_dropped(tmp_path, stamps, left_out, caplog):
    write_bag(
        tmp_path, "street", {"/points": plain_clouds(20)}, stamps=5000 + np.array([stamps.get(i, i) for i in range(20)])
    )
    (tmp_path / "street.txt").write_text(kitti_rows(curve(20)))
    sequence = rosbag(tmp_path).sequence("street")
    coordinates = [first_x(sequence, i) for i in range(len(sequence))]
    kept = [i for i in range(20) if float(random_points(i)[0, 0]) in coordinates]
    assert len(kept) == len(sequence) == 19 and {*range(20)} - {*kept} <= left_out
    assert (sequence.timestamps.diff() > 0).all()
    assert np.allclose(sequence.T_world_lidar, np.linalg.inv(curve(20)[kept[0]]) @ curve(20)[kept])
    assert "street: 1 clouds of /points with a time out of order are left out" in caplog.text
