"""Backends that are built in Python are those of the configs."""

from pathlib import Path
from typing import Any

import pytest
from hydra.utils import instantiate
from torch import Tensor

import lidarlearn
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.odometry import Odometry, presets
from lidarlearn.odometry.initialization import ConstantVelocity
from tests.odometry.odometries import ASSOCIATIONS, composed, scans


def contents(value: Any) -> Any:
    """All that an object consists of, down to what can be compared; tensors have yet to be filled."""
    if isinstance(value, Tensor):
        return value.dtype, value.device, value.shape
    if isinstance(value, dict):
        return {key: contents(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [contents(inner) for inner in value]
    if hasattr(value, "__dict__"):
        return type(value), contents(vars(value))
    return value


@pytest.mark.parametrize("association", ASSOCIATIONS)
@pytest.mark.parametrize(("projection", "device"), [("hdl64", "cpu"), ("vlp16", "cpu"), ("vlp16", "meta")])
def test_a_preset_is_what_its_yaml_makes(association, projection, device):
    config = composed(f"projection@data.projection={projection}", f"device={device}")
    sensor, build = instantiate(config.data.projection), getattr(presets, f"{association}_f2m")
    f2m, f2f = (contents(build(sensor, device=device, **size)) for size in ({}, {"size": 1}))
    assert f2m == contents(instantiate(config.odometry[f"{association}_f2m"])) != f2f
    assert f2f == contents(instantiate(config.odometry[f"{association}_f2f"]))


def test_so_is_an_odometry_around_it():
    parts = ConstantVelocity(), presets.kd_f2m(SphericalProjection())
    assert contents(Odometry(*parts)) == contents(instantiate(composed().pipeline)(*parts))


def test_what_the_readme_shows_runs_as_printed(capsys):
    readme = (Path(lidarlearn.__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    exec(readme.partition("```python\n")[2].partition("```")[0], {"scans": scans()[:3]})
    assert capsys.readouterr().out.count("False") == 3
