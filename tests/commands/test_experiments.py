"""Every experiment of `configs/experiment` composes into what its command needs."""

import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

from lidarlearn.commands import entry_point
from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.evaluate import configured_method
from lidarlearn.evaluation.table_layout import TableLayout

FOLDER = config_directory() / "experiment"


def names(folder):
    return sorted(path.relative_to(FOLDER).with_suffix("").as_posix() for path in (FOLDER / folder).glob("*.yaml"))


TABLES = [name for name in names("paper") if name != "paper/settings"]


def composed(program, experiment):
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        return compose(program, [f"experiment={experiment}", "run_dir=x"], return_hydra_config=True)


@pytest.mark.parametrize("name", TABLES)
def test_a_table_has_its_methods_networks_and_columns(name):
    config = composed("evaluate", name)
    layout: TableLayout = instantiate(config.table, _convert_="all")
    methods = [str(configured_method(config, method)) for method in config.methods]
    in_table = {sequence for column in layout.columns.values() for sequence in column}
    assert set(config.data.test_sequences) <= in_table
    assert set(methods) - set(layout.published) <= {"posenet_supervised"}  # beside the paper's rows
    for network in {method.partition("+")[0] for method in methods} & set(config.networks):
        assert Path(config.networks[network]).parent.parent.relative_to("outputs").as_posix() in names("network")


@pytest.mark.parametrize("name", names("network"))
def test_a_network_lies_where_the_tables_look_for_it(name):
    hydra = composed("train", name).hydra
    folder = f"outputs/{name}"
    assert hydra.run.dir == folder == f"{hydra.sweep.dir}/{hydra.sweep.subdir}"


def test_networks_trained_in_one_multirun_lie_there_too(tmp_path, monkeypatch):
    seen = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train.py", "-m", "experiment=network/nclt,network/simulated_urban"])
    entry_point.run(lambda config: seen.append(Path(config.run_dir)), "train")
    assert seen == [tmp_path / "outputs/network" / name for name in ("nclt", "simulated_urban")]


def test_every_table_of_the_paper_has_a_stand_in():
    originals = [name for name in TABLES if not name.endswith(("_sim", "_ford"))]
    assert len(originals) == 7
    assert {f"{name}_sim" for name in originals} <= set(TABLES)


def test_the_papers_settings_are_those_of_its_runs():
    config = composed("evaluate", "paper/settings")
    p, kd = config.odometry.p_f2m, config.odometry.kd_f2m
    assert (p.local_map.size, p.registration.max_iterations) == (20, 15)
    assert (kd.local_map.size, kd.registration.max_iterations) == (30, 20)
    for backend in (p, kd, config.odometry.p_f2f, config.odometry.kd_f2f):
        weight = backend.registration.weight
        assert weight == {"_target_": "lidarlearn.registration.weights.Proximity", "sigma_m": 0.2}
    assert (p.local_map.key_frame_distance_m, p.local_map.key_frame_angle_deg) == (0.1, 0.3)
    assert config.odometry.kd_f2f.local_map.size == 1 and not config.pipeline.recovery


def test_the_options_of_a_network_exist_and_its_name_says_its_loss():
    for name in names("network"):
        node = OmegaConf.load(FOLDER / f"{name}.yaml")
        options = [option for default in node.defaults for option in default.items()]
        assert all((config_directory() / group.split()[-1].strip("/") / f"{o}.yaml").is_file() for group, o in options)
        assert ({"override /loss": "supervised"} in node.defaults) == ("supervised" in name)


def test_the_test_server_gets_the_drives_without_public_poses():
    config = composed("evaluate", "kitti_submission")
    assert list(config.data.test_sequences) == [str(i) for i in range(11, 22)]
