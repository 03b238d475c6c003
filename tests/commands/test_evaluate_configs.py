"""The options of evaluate.py and of the measurement of convergence basins fit what they configure."""

import pytest
from omegaconf import OmegaConf

from tests.commands.configs import check_binds, composed, option_nodes, options

PLACES = {
    "initialization": "initialization.cv",
    "odometry": "odometry.p_f2m",
    "weight": "odometry.kd_f2m.registration.weight",
    "residual": "odometry.kd_f2m.registration.residual",
    "baseline": "baseline.kiss_icp",
    "pipeline": "pipeline",
    "projection": "data.projection",
}


@pytest.fixture(scope="module")
def nodes():
    return option_nodes("evaluate", *PLACES)


@pytest.mark.parametrize(("group", "option"), [(group, option) for group in PLACES for option in options(group)])
def test_option_binds_to_its_target(nodes, group, option):
    check_binds(nodes[group, option])


def test_options_replace_the_defaults_at_their_places(nodes):
    chosen = {group: options(group)[-1] for group in PLACES}
    places = {group: group if group == place else f"{group}@{place}" for group, place in PLACES.items()}
    config = composed("evaluate", *(f"{places[group]}={option}" for group, option in chosen.items()))
    default = composed("evaluate")
    for group, option in chosen.items():
        node = OmegaConf.select(config, PLACES[group])
        assert OmegaConf.to_container(node) == OmegaConf.to_container(nodes[group, option])
        assert node != OmegaConf.select(default, PLACES[group])


def test_settings_of_convergence_bind_to_their_targets():
    check_binds(composed("convergence"))
