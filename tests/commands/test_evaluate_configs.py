"""Every option of every group of configs/evaluate.yaml and configs/convergence.yaml fits what it configures."""

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from lidarlearn.commands.configs import config_directory
from tests.commands.binding import check_binds

CONFIGS = config_directory()
PLACES = {
    "initialization": "initialization.cv",
    "odometry": "odometry.kd_f2m",
    "weight": "odometry.kd_f2m.registration.weight",
    "residual": "odometry.kd_f2m.registration.residual",
    "baseline": "baseline.kiss_icp",
    "pipeline": "pipeline",
    "projection": "data.projection",
}
OPTIONS = [
    (group, path.relative_to(CONFIGS / group).with_suffix("").as_posix())
    for group in PLACES
    for path in sorted((CONFIGS / group).rglob("*.yaml"))
]


def composed(program, *overrides):
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return compose(program, ["run_dir=run", *overrides])


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_every_option_composes_and_binds_to_its_target(group, option):
    place = PLACES[group]
    config = composed("evaluate", f"{group}={option}" if group == place else f"{group}@{place}={option}")
    check_binds(OmegaConf.to_container(OmegaConf.select(config, place), resolve=True))


def test_what_probes_the_basins_of_convergence_binds_to_its_target():
    check_binds(OmegaConf.to_container(composed("convergence"), resolve=True))
