import pytest

from lidarlearn.errors import UserError
from lidarlearn.evaluation.methods import BACKENDS, INITIALIZATIONS, Method, parse_method


@pytest.mark.parametrize("initialization", INITIALIZATIONS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_names_say_the_parts_and_the_parts_the_name(initialization, backend):
    method = parse_method(f"{initialization}+{backend}")
    assert method == Method(initialization, backend)
    assert str(method) == f"{initialization}+{backend}"


@pytest.mark.parametrize("initialization", INITIALIZATIONS)
def test_an_initialization_can_stand_alone(initialization):
    method = parse_method(initialization)
    assert method == Method(initialization, None) and str(method) == initialization


def test_the_papers_capitals_are_understood():
    assert parse_method("CV+Kd_F2M") == Method("cv", "kd_f2m")


def test_every_combination_of_the_paper_exists():
    assert set(INITIALIZATIONS) == {"ni", "cv", "ei", "posenet"}
    assert set(BACKENDS) == {f"{a}_{m}" for a in ("p", "kd", "vh") for m in ("f2f", "f2m")}


@pytest.mark.parametrize(
    "name", ["", "icp", "cv+", "cv+icp_f2m", "kd_f2m", "cv+kd", "+kd_f2m", "cv kd_f2m", "cv+kd_f2m+"]
)
def test_other_names_are_refused_with_the_ones_there_are(name):
    with pytest.raises(UserError, match=r"no method '.*'\.\n  change: .*cv\+kd_f2m") as error:
        parse_method(name)
    assert all(part in str(error.value) for part in (*INITIALIZATIONS, *BACKENDS))


def test_networks_are_initializations_by_their_own_names():
    assert parse_method("posenet_icp+kd_f2m", ["posenet_icp"]) == Method("posenet_icp", "kd_f2m")
    with pytest.raises(UserError, match="posenet_icp"):
        parse_method("posenet_cpi", ["posenet_icp"])
