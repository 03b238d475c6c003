"""`--help` of the commands names what can be chosen, and nothing that nobody should choose."""

import string

import pytest
from hydra import compose, initialize_config_dir

from lidarlearn.commands.configs import config_directory

CONFIGS = config_directory()
GROUPS = {
    "train": ("data", "loss", "optimizer", "schedulers", "projection"),
    "evaluate": ("data", "projection", "pipeline", "weight", "residual", "baseline", "initialization"),
    "convergence": ("odometry",),
}


def help_of(program):
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = compose(program, return_hydra_config=True)
    return string.Template(config.hydra.help.template).substitute()  # as Hydra does: a lone dollar sign is an error


def words(text):
    return set(text.translate(str.maketrans(dict.fromkeys(",:;()[]'", " "))).split())


@pytest.mark.parametrize(("program", "group"), [(p, g) for p, groups in GROUPS.items() for g in groups])
def test_every_option_is_named(program, group):
    assert {path.stem for path in (CONFIGS / group).glob("*.yaml")} <= words(help_of(program))


def test_the_parts_of_methods_are_named():
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = compose("evaluate")
    parts = {part for backend in config.odometry for part in backend.split("_")}
    assert {*config.initialization, *parts, *config.baseline} <= words(help_of("evaluate"))


@pytest.mark.parametrize("program", GROUPS)
def test_it_is_about_the_command_and_fits_a_terminal(program):
    text = help_of(program)
    assert "powered by Hydra" not in text and "base/" not in text
    assert max(map(len, text.splitlines())) <= 108


@pytest.mark.parametrize("program", GROUPS)
def test_every_setting_that_is_named_exists(program):
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = compose(program, return_hydra_config=True)
    settings = {w for w in words(help_of(program)) if w.split(".")[0] in config and "." in w and "=" not in w}
    for setting in {w.partition("@")[2] or w for w in settings} - {"data.projection"}:
        node, _, key = setting.rpartition(".")
        holder = config
        for name in node.split("."):
            holder = holder[name]
        assert key in holder, setting
