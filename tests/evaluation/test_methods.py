import pytest

from lidarlearn.commands.evaluate import configured_method
from lidarlearn.errors import UserError
from lidarlearn.evaluation.methods import Method, parse_method
from tests.odometry.odometries import composed

INITIALIZATIONS = ("ni", "cv", "ei", "posenet")
BACKENDS = tuple(f"{a}_{m}" for a in ("p", "kd", "vh") for m in ("f2f", "f2m"))
BASELINES = ("kiss_icp", "small_gicp")


def parsed(name: str, *networks: str) -> Method:
    return parse_method(name, [*INITIALIZATIONS, *networks], BACKENDS, BASELINES)


@pytest.mark.parametrize("initialization", INITIALIZATIONS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_every_method_of_the_paper_is_configured(initialization, backend):
    method = configured_method(composed(), f"{initialization}+{backend}")
    assert method == Method(initialization, backend)
    assert str(method) == f"{initialization}+{backend}"


@pytest.mark.parametrize("name", [*INITIALIZATIONS, *BASELINES])
def test_initialization_or_baseline_alone_is_a_method(name):
    method = configured_method(composed(), name)
    assert method == Method(name, None) and str(method) == name


def test_method_names_ignore_case():
    assert parsed("CV+Kd_F2M") == Method("cv", "kd_f2m")


@pytest.mark.parametrize(
    "name", ["", "icp", "cv+", "cv+icp_f2m", "kd_f2m", "cv+kd", "+kd_f2m", "cv kd_f2m", "cv+kd_f2m+", "kiss_icp+kd_f2m"]
)
def test_unknown_method_error_lists_valid_names(name):
    with pytest.raises(UserError, match=r"no method '.*'\.\n  change: .*cv\+kd_f2m") as error:
        parsed(name)
    assert all(part in str(error.value) for part in (*INITIALIZATIONS, *BACKENDS, *BASELINES))


@pytest.mark.parametrize("name", ["PoseNet_ICP+kd_f2m", "posenet_icp+kd_f2m"])
def test_networks_are_initializations_ignoring_case(name):
    assert parsed(name, "PoseNet_ICP") == Method("PoseNet_ICP", "kd_f2m")
    with pytest.raises(UserError, match="PoseNet_ICP"):
        parsed("posenet_cpi", "PoseNet_ICP")


def test_custom_backend_is_configured_by_name():
    config = composed("+odometry@odometry.mine=kd_f2m")
    assert configured_method(config, "cv+mine") == Method("cv", "mine")
