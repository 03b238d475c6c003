"""Backends and odometries that are built in Python equal those of the configs."""

from pathlib import Path
from typing import Any

import pytest
from hydra.utils import instantiate
from torch import Tensor

import lidarlearn
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.odometry import Backend, GridSampling, LocalMap, Odometry, presets
from lidarlearn.odometry.initialization import ConstantVelocity
from lidarlearn.registration.association import KdTree
from tests.odometry.odometries import ASSOCIATIONS, build, configured, street_scans


def contents(value: Any) -> Any:
    """The attributes of an object, down to values that can be compared; of tensors, which are empty, the shape."""
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
@pytest.mark.parametrize(("projection", "device"), [("hdl64", "cpu"), ("vlp16", "meta")])
def test_preset_equals_config(association, projection, device):
    config = configured(f"device={device}", projection=projection)
    sensor, preset = instantiate(config.data.projection), getattr(presets, f"{association}_f2m")
    f2m, f2f = (contents(preset(sensor, device=device, **size)) for size in ({}, {"size": 1}))
    assert f2m == contents(instantiate(config.odometry[f"{association}_f2m"])) != f2f
    assert f2f == contents(instantiate(config.odometry[f"{association}_f2f"]))


@pytest.mark.parametrize(
    "backend",
    [lambda: presets.kd_f2m(SphericalProjection()), lambda: Backend(GridSampling(), LocalMap(KdTree()))],
    ids=["preset", "defaults"],
)
def test_odometry_in_python_equals_cv_kd_f2m(backend):
    assert contents(Odometry(ConstantVelocity(), backend())) == contents(build("cv+kd_f2m"))


def test_python_example_of_readme_runs(capsys):
    readme = (Path(lidarlearn.__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    exec(readme.partition("```python\n")[2].partition("```")[0], {"scans": street_scans()[:3]})
    assert capsys.readouterr().out.count("False") == 3
