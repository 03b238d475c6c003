import os
import threading
import time
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
from filelock import FileLock

from lidarlearn.data.errors import DamagedFileError, DataSetNotFoundError
from lidarlearn.data.range_images import image_path
from lidarlearn.data.simulated import SimulatedDataSet
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.simulation.sensors import hdl64
from lidarlearn.simulation.worlds import PRESETS, build_world
from tests import scenes


@pytest.fixture(autouse=True, scope="module")
def bare_streets():
    """Bare streets, which are built quickly: these tests are about the files of scans."""
    bare = replace(PRESETS["urban"], furnish=lambda site: None, side_streets=None, pedestrians=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "urban", bare)
        yield


ONLY_TRAIN = {"val_sequences": [], "test_sequences": []}


def _data_set(root, **changes):
    settings = {"train_sequences": ["urban_00"], "val_sequences": ["urban_01"], "test_sequences": ["urban_02"]}
    settings |= {"frames": 4, "sensor": hdl64(64), "workers": 0}
    return SimulatedDataSet(root, SphericalProjection(), **(settings | changes))


def _bytes(data_set):
    names = [*data_set.train_sequences, *data_set.val_sequences, *data_set.test_sequences]
    return {name: [scan.points.numpy().tobytes() for scan in data_set.sequence(name)] for name in names}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    data_set = _data_set(tmp_path_factory.mktemp("simulated"))
    data_set.prepare()
    return data_set


def test_sequence_has_scans_and_ground_truth(made):
    sequence = made.sequence("urban_02")
    assert len(sequence) == len(sequence.T_world_lidar) == len(sequence.timestamps) == 4
    assert sequence.T_world_lidar.dtype == torch.float64
    assert torch.equal(sequence.T_world_lidar[0], torch.eye(4, dtype=torch.float64))
    assert sequence.scan(3).points.dtype == torch.float32 and sequence.scan(3).times is None


def test_stored_scan_equals_scan_of_drive(made):
    drive = made._drive("urban_01")
    assert torch.equal(made.sequence("urban_01").scan(2).points, drive.scan(2).points)


def test_sequences_have_different_worlds(made):
    assert made.sequence("urban_00").fingerprint != made.sequence("urban_02").fingerprint
    assert not torch.equal(made.sequence("urban_00").T_world_lidar, made.sequence("urban_02").T_world_lidar)


def test_scans_do_not_depend_on_number_of_workers(made, tmp_path):
    other = _data_set(tmp_path, workers=2)
    other.prepare(["urban_00"])  # one drive for both workers
    other.prepare()  # one drive for each worker
    assert _bytes(other) == _bytes(made)


def test_prepare_makes_requested_sequences_only(tmp_path):
    data_set = _data_set(tmp_path)
    data_set.prepare(["urban_02"])
    assert len(data_set.sequence("urban_02")) == 4
    with pytest.raises(DataSetNotFoundError, match="urban_01"):
        data_set.sequence("urban_01")


def test_repeated_prepare_writes_nothing(made):
    files = sorted(made.root.rglob("*.npy"))
    before = [file.stat().st_mtime_ns for file in files]
    made.prepare()
    assert [file.stat().st_mtime_ns for file in files] == before


def test_prepare_continues_after_interruption(made, tmp_path):
    data_set = _data_set(tmp_path, **ONLY_TRAIN)
    data_set.prepare()
    folder = data_set.folder(data_set._drive("urban_00"))
    kept = image_path(folder, 1).stat().st_mtime_ns
    image_path(folder, 2).unlink()
    image_path(folder, 3).with_suffix(".tmp").write_bytes(b"half a fi")
    with pytest.raises(DataSetNotFoundError, match="scan 2 of sequence urban_00"):
        data_set.sequence("urban_00")
    assert {finding.what: finding.level for finding in data_set.check().findings}["urban_00"] == "odd"
    data_set.prepare()
    assert image_path(folder, 1).stat().st_mtime_ns == kept
    assert _bytes(data_set)["urban_00"] == _bytes(made)["urban_00"]


def test_workers_build_world_once_and_release_it(tmp_path, monkeypatch):
    built = []

    def build(*settings):
        world = build_world(*settings)
        built.append(weakref.ref(world))
        return world

    monkeypatch.setattr("lidarlearn.simulation.drive.build_world", build)
    _data_set(tmp_path, workers=4, **ONLY_TRAIN).prepare()
    assert len(built) == 1 and built[0]() is None


def test_prepare_reports_waiting_for_other_process(tmp_path, capsys):
    data = _data_set(tmp_path, **ONLY_TRAIN)
    with FileLock(tmp_path / "simulation.lock"):
        waiting = threading.Thread(target=data.prepare)
        waiting.start()
        printed = ""
        while waiting.is_alive() and "waiting for another process that simulates" not in printed:
            printed += capsys.readouterr().out
            time.sleep(0.01)
        assert waiting.is_alive()
    waiting.join()
    assert len(data.sequence("urban_00")) == 4


def test_prepare_raises_errors_of_workers(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "lidarlearn.data.range_images.image_path", lambda folder, index: folder / "nowhere" / f"{index}.npy"
    )
    with pytest.raises(FileNotFoundError):
        _data_set(tmp_path, workers=2, **ONLY_TRAIN).prepare()


def test_other_settings_use_separate_folders(made):
    other = _data_set(made.root, frames=3, **ONLY_TRAIN)
    with pytest.raises(DataSetNotFoundError, match=r"prepare\(\)"):
        other.sequence("urban_00")
    other.prepare()
    assert len(other.sequence("urban_00")) == 3 and len(made.sequence("urban_00")) == 4


def test_max_frames_makes_first_scans_of_same_drive(made, tmp_path):
    short = _data_set(tmp_path, max_frames=2, **ONLY_TRAIN)
    short.prepare()
    assert len(short.sequence("urban_00")) == 2
    assert torch.equal(short.sequence("urban_00").scan(1).points, made.sequence("urban_00").scan(1).points)
    assert len(list(tmp_path.rglob("*.npy"))) == 2


def test_distorted_scans_have_point_times(tmp_path):
    data_set = _data_set(tmp_path, motion_distortion=True, **ONLY_TRAIN, max_frames=1)
    data_set.prepare()
    scan = data_set.sequence("urban_00").scan(0)
    assert scan.times is not None and scan.times.shape == scan.points.shape[:1]


def test_pose_file_sets_trajectory(tmp_path):
    poses = scenes.straight_path(9, 1.38)
    np.savetxt(tmp_path / "04.txt", poses[:, :3].reshape(-1, 12))
    data_set = _data_set(tmp_path, pose_file=tmp_path / "04.txt", pose_file_frame="lidar", max_frames=1, **ONLY_TRAIN)
    assert len(data_set._drive("urban_00")) == 9 > data_set.frames
    assert data_set._drive("urban_00").T_world_lidar[3, :3, 3].tolist() == pytest.approx([3 * 1.38, 0, 0])


def test_truncated_file_error_names_file(made):
    path = image_path(made.folder(made._drive("urban_01")), 3)
    whole = path.read_bytes()
    path.write_bytes(whole[:300])
    with pytest.raises(DamagedFileError, match=path.name):
        made.sequence("urban_01").scan(3)
    path.write_bytes(whole)


def test_data_set_may_mix_worlds(tmp_path):
    data_set = _data_set(tmp_path, train_sequences=["urban_00", "highway_00"], max_frames=1, **ONLY_TRAIN)
    data_set.prepare()
    assert len(data_set.sequence("urban_00")) == len(data_set.sequence("highway_00")) == 1
    town_m, motorway_m = (data_set._drive(name).T_world_lidar[3, :3, 3].norm() for name in ("urban_00", "highway_00"))
    assert motorway_m > 1.5 * town_m


@pytest.mark.parametrize("name", ["village_00", "urban", "00", "urban_x"])
def test_sequence_of_unknown_world_is_refused(made, name):
    with pytest.raises(UserError, match=r"urban_07, highway_07"):
        made.sequence(name)


def test_unknown_world_error_names_setting(tmp_path):
    with pytest.raises(UserError, match=r"no simulated sequence 'town_1'.\n  change: data.test_sequences to names"):
        _data_set(tmp_path, test_sequences="town_1").prepare()


def test_beam_correction_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"data\.beam_correction_deg=0\b"):
        _data_set(tmp_path, beam_correction_deg=0.205)


def test_deskew_requires_motion_distortion(tmp_path):
    with pytest.raises(UserError, match=r"data\.motion_distortion=true"):
        _data_set(tmp_path, deskew=True)
    assert _data_set(tmp_path, deskew=True, motion_distortion=True).deskew


def test_other_simulator_code_uses_separate_folder(made, tmp_path, monkeypatch):
    before = made.folder(made._drive("urban_00"))
    monkeypatch.setattr("lidarlearn.simulation.drive.source_digest", lambda *files, within: "changed")
    after = made.folder(made._drive("urban_00"))
    assert after.parent == made.root / "simulator_changed" and before.parent.parent == made.root
    assert before.parent != after.parent and before.name != after.name


def test_check_reports_prepared_sequences(made):
    assert made.check().usable
    assert {finding.level for finding in made.check().findings} == {"found"}
    assert os.path.isdir(made.root)
