"""The experiments of `configs/experiment` fit the programs and each other."""

import sys
from pathlib import Path

import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from lidarlearn.commands import entry_point
from lidarlearn.commands.evaluate import configured_method
from lidarlearn.evaluation.table_layout import TableLayout
from tests.commands.configs import composed, composed_with_hydra, options

NETWORKS = [f"network/{name}" for name in options("experiment/network")]
TABLES = [f"paper/{name}" for name in options("experiment/paper") if name != "settings"]


@pytest.mark.parametrize("name", TABLES)
def test_table_columns_and_networks_fit_its_methods_and_sequences(name):
    config = composed("evaluate", f"experiment={name}")
    layout: TableLayout = instantiate(config.table, _convert_="all")
    methods = [str(configured_method(config, method)) for method in config.methods]
    in_table = {sequence for column in layout.columns.values() for sequence in column}
    assert set(config.data.test_sequences) <= in_table
    assert set(methods) - set(layout.published) <= {"posenet_supervised"}  # beside the paper's rows
    for network in {method.partition("+")[0] for method in methods} & set(config.networks):
        folder = Path(config.networks[network]).parent.parent
        assert folder.relative_to("outputs").as_posix() in NETWORKS


@pytest.mark.parametrize("name", NETWORKS)
def test_network_is_written_where_tables_read_it(name):
    hydra = composed_with_hydra("train", f"experiment={name}").hydra
    folder = f"outputs/{name}"
    assert hydra.run.dir == folder == f"{hydra.sweep.dir}/{hydra.sweep.subdir}"


@pytest.mark.parametrize("name", NETWORKS)
def test_network_resolves_and_its_name_tells_the_loss(name):
    config = OmegaConf.to_container(composed("train", f"experiment={name}"), resolve=True, throw_on_missing=True)
    assert ("Supervised" in config["loss"]["_target_"]) == ("supervised" in name)


@pytest.mark.slow
def test_multirun_writes_networks_where_tables_read_them(tmp_path, monkeypatch):
    seen = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train.py", "-m", "experiment=network/nclt,network/simulated_urban"])
    entry_point.run(lambda config: seen.append(Path(config.run_dir)), "train")
    assert seen == [tmp_path / "outputs/network" / name for name in ("nclt", "simulated_urban")]


def test_kitti_mapping_resolves():
    OmegaConf.to_container(composed("train", "experiment=kitti_04_mapping"), resolve=True, throw_on_missing=True)


def test_every_table_has_a_simulated_counterpart():
    originals = [name for name in TABLES if not name.endswith(("_sim", "_ford"))]
    assert len(originals) == 7
    assert {f"{name}_sim" for name in originals} <= set(TABLES)


def test_paper_settings_are_those_of_its_kitti_runs():
    config = composed("evaluate", "experiment=paper/settings")
    p, kd = config.odometry.p_f2m, config.odometry.kd_f2m
    assert (p.local_map.size, p.registration.max_iterations) == (20, 15)
    assert (kd.local_map.size, kd.registration.max_iterations) == (30, 20)
    for backend in (p, kd, config.odometry.p_f2f, config.odometry.kd_f2f):
        weight = backend.registration.weight
        assert weight == {"_target_": "lidarlearn.registration.weights.Proximity", "sigma_m": 0.2}
    assert (p.local_map.key_frame_distance_m, p.local_map.key_frame_angle_deg) == (0.1, 0.3)
    assert config.odometry.kd_f2f.local_map.size == 1 and not config.pipeline.recovery


def test_kitti_submission_runs_the_drives_without_public_poses():
    config = composed("evaluate", "experiment=kitti_submission")
    assert list(config.data.test_sequences) == [str(i) for i in range(11, 22)]
