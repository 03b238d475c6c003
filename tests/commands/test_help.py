"""`--help` lists the existing options and settings."""

import string

import pytest

from tests.commands.configs import CONFIGS, composed, composed_with_hydra

GROUPS = {
    "train": ("data", "loss", "optimizer", "schedulers", "projection"),
    "evaluate": ("data", "projection", "pipeline", "weight", "residual", "baseline", "initialization"),
    "convergence": ("odometry",),
}


def help_of(program):
    template = string.Template(composed_with_hydra(program).hydra.help.template)
    return template.substitute()  # like Hydra: a lone dollar sign is an error


def words(text):
    return set(text.translate(str.maketrans(dict.fromkeys(",:;()[]'", " "))).split())


@pytest.mark.parametrize(("program", "group"), [(p, g) for p, groups in GROUPS.items() for g in groups])
def test_help_lists_all_options_of_group(program, group):
    assert {path.stem for path in (CONFIGS / group).glob("*.yaml")} <= words(help_of(program))


def test_evaluate_help_lists_parts_of_methods():
    config = composed("evaluate")
    parts = {part for backend in config.odometry for part in backend.split("_")}
    assert {*config.initialization, *parts, *config.baseline} <= words(help_of("evaluate"))


@pytest.mark.parametrize("program", GROUPS)
def test_help_is_our_own_and_fits_a_terminal(program):
    text = help_of(program)
    assert "powered by Hydra" not in text and "base/" not in text
    assert max(map(len, text.splitlines())) <= 108


@pytest.mark.parametrize("program", GROUPS)
def test_settings_in_help_exist(program):
    config = composed_with_hydra(program)
    settings = {w for w in words(help_of(program)) if w.split(".")[0] in config and "." in w and "=" not in w}
    for setting in {w.partition("@")[2] or w for w in settings} - {"data.projection"}:
        node, _, key = setting.rpartition(".")
        holder = config
        for name in node.split("."):
            holder = holder[name]
        assert key in holder, setting
