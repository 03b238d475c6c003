"""Both projective losses: minima, masks, batches, gradients."""

import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.geometry.normals import normal_map
from lidarlearn.geometry.projection import activated
from lidarlearn.losses.icp import IcpLoss
from lidarlearn.losses.projective import reproject
from lidarlearn.losses.weighted_icp import WeightedIcpLoss
from tests.box_world import SMALL, cast

FINE = type(SMALL)(height=32, width=360, fov_up_deg=15.0, fov_down_deg=-20.0)
TRUTH = torch.tensor([[0.30, -0.05, 0.02, 0.004, -0.006, 0.02]], dtype=torch.float64)
LOSSES = [IcpLoss(), WeightedIcpLoss(), WeightedIcpLoss(sigma_m=2.0)]
NAMES = ["icp", "weighted_icp", "weighted_icp_2m"]


@pytest.fixture(scope="module")
def pair():
    """Reference at the origin, target at the true motion."""
    reference = FINE.vertex_map(cast(se3.identity(), FINE))[None]
    target = FINE.vertex_map(cast(se3.from_euler(TRUTH)[0], FINE))[None]
    return reference, target


@pytest.mark.parametrize("loss", LOSSES, ids=NAMES)
def test_loss_of_identical_scans_is_zero(loss, pair):
    result = loss(torch.zeros(1, 6), pair[0], pair[0], FINE)
    assert result.loss < 1e-9
    assert 0.3 < result.parts["activated_share"] <= 1


@pytest.mark.parametrize("loss", LOSSES, ids=NAMES)
@pytest.mark.parametrize("direction", range(6))
@pytest.mark.parametrize("sign", [-1, 1])
def test_loss_is_lower_at_true_motion_than_off_it(loss, direction, sign, pair):
    truth = TRUTH.float()
    off = truth.clone()
    off[0, direction] += sign * (0.15 if direction < 3 else 0.03)
    assert loss(truth, *pair, FINE).loss < 0.8 * loss(off, *pair, FINE).loss


@pytest.mark.parametrize("direction", [0, 1])
def test_misfit_grows_with_offset_up_to_one(direction, pair):
    def misfit(off_m):
        return LOSSES[1](TRUTH.float() + off_m * torch.eye(6)[direction], *pair, FINE).parts["misfit"].item()

    values = [misfit(off_m) for off_m in (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0)]
    assert values == sorted(values) and 0 < values[0] < 0.2 and values[-1] > 0.99


@pytest.mark.parametrize("loss", LOSSES[:2], ids=NAMES[:2])
def test_gradient_descent_recovers_motion(loss, pair):
    parameters = torch.zeros(1, 6, requires_grad=True)
    optimizer = torch.optim.Adam([parameters], lr=0.05)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.85)
    for _ in range(35):
        optimizer.zero_grad()
        loss(parameters, *pair, FINE).loss.backward()
        optimizer.step()
        schedule.step()
    error = (parameters.detach() - TRUTH.float())[0]
    assert error[:3].norm() < 0.03
    assert error[3:].norm() < 0.005


@pytest.mark.parametrize("loss", LOSSES, ids=NAMES)
def test_batch_loss_is_mean_of_pair_losses(loss, pair):
    reference, target = pair
    full = (reference, target)
    half = (reference * (torch.arange(FINE.width) < 120), target)  # far fewer activated pixels
    parameters = torch.tensor([[0.1, 0, 0, 0, 0, 0.01], [0.2, 0.1, 0, 0, 0, 0]])
    together = loss(parameters, torch.cat([full[0], half[0]]), torch.cat([full[1], half[1]]), FINE)
    alone = [loss(parameters[i : i + 1], *p, FINE) for i, p in enumerate((full, half))]
    torch.testing.assert_close(together.loss, (alone[0].loss + alone[1].loss) / 2)
    for part in together.parts:
        torch.testing.assert_close(together.parts[part], (alone[0].parts[part] + alone[1].parts[part]) / 2)


@pytest.mark.parametrize("loss", LOSSES, ids=NAMES)
def test_pair_without_overlap_has_no_loss_and_gradient(loss, pair):
    reference = torch.cat([pair[0], torch.zeros_like(pair[0])])
    target = torch.cat([pair[1], pair[1]])
    parameters = torch.zeros(2, 6, requires_grad=True)
    result = loss(parameters, reference, target, FINE)
    result.loss.backward()
    torch.testing.assert_close(result.loss, loss(torch.zeros(1, 6), *pair, FINE).loss / 2)
    assert parameters.grad[0].abs().sum() > 0
    assert (parameters.grad[1] == 0).all()


@pytest.mark.parametrize("loss", LOSSES, ids=NAMES)
@pytest.mark.parametrize(("shares", "far_off"), [((1, 0), 0.0), ((0, 1), 0.0), ((1, 1), 1e4)])
def test_batch_without_overlap_has_zero_loss_and_gradient(loss, shares, far_off, pair):
    reference, target = (share * image for share, image in zip(shares, pair, strict=True))
    parameters = torch.tensor([[0.0, 0, far_off, 0, 0, 0]], requires_grad=True)
    result = loss(parameters, reference, target, FINE)
    result.loss.backward()
    assert result.loss == 0 and result.parts["activated_share"] == 0 and result.parts["misfit"] == 1
    assert (parameters.grad == 0).all()


def scattered(reference, phase):
    """A patch of the image without two neighbours at a similar range: nothing there has a normal."""
    row, column = torch.arange(FINE.height)[:, None], torch.arange(FINE.width)
    factor = 2.0 ** (1 + (row + phase) % 3 * 3 + column % 3)
    patch = ((row - 16).abs() < 8) & ((column - 180).abs() < 40)
    return torch.where(patch, factor * reference, reference)


@pytest.mark.parametrize("loss", LOSSES, ids=NAMES)
def test_loss_ignores_reference_pixels_without_normal(loss, pair):
    """Reference points without a normal may be anywhere, or missing."""
    reference, target = pair
    here, there = scattered(reference, 0), scattered(reference, 1)
    nowhere = torch.where(here == reference, reference, 0.0)
    results = [loss(TRUTH.float(), one, target, FINE) for one in (here, there, nowhere)]
    assert results[0].loss == results[1].loss == results[2].loss
    assert results[0].parts == results[1].parts == results[2].parts
    assert (nowhere == 0).sum() > (reference == 0).sum() + 1000


def test_icp_gradient_matches_finite_differences(pair):
    """In double precision, away from the truth where |r| has kinks, with the association fixed by tiny steps."""
    reference, target = (m.double()[..., 8:24, :] for m in pair)
    projection = type(SMALL)(height=16, width=360, fov_up_deg=15.0 - 8 * 35 / 32, fov_down_deg=-20.0 + 8 * 35 / 32)
    start = (TRUTH * 0.5).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda p: IcpLoss()(p, reference, target, projection).loss, (start,), eps=1e-9, atol=1e-4, rtol=1e-3
    )


def test_weighted_gradient_matches_reweighted_least_squares(pair):
    """The weights are constants: d/dp of w0 r(p)^2 with w0 taken at p."""
    reference, target = (m.double() for m in pair)
    loss = WeightedIcpLoss(sigma_m=0.5)
    start = TRUTH * 0.5
    parameters = start.clone().requires_grad_()
    loss(parameters, reference, target, FINE).loss.backward()

    normals = normal_map(reference, loss.normal_window, loss.max_range_jump, loss.max_roughness)
    at_start = reproject(se3.from_euler(start), target, FINE)
    weights = (-(at_start - reference).square().sum(1) / 0.5**2).exp()
    used = activated(reference) & activated(at_start) & activated(normals)

    def energy(p):
        residuals = ((reproject(se3.from_euler(p), target, FINE) - reference) * normals).sum(1)
        return (weights * residuals.square())[used].mean()

    step = 1e-7 * torch.eye(6, dtype=torch.float64)
    numeric = torch.stack([(energy(start + s) - energy(start - s)) / 2e-7 for s in step])
    torch.testing.assert_close(parameters.grad[0], numeric, atol=1e-5, rtol=1e-3)


def test_icp_loss_of_lifted_floor_is_its_height():
    """Closed form: a plane lifted by 0.1 m is 0.1 m from itself, whatever the association."""
    x, y = torch.meshgrid(torch.linspace(-20, 20, 400), torch.linspace(-20, 20, 400), indexing="ij")
    floor = FINE.vertex_map(torch.stack([x, y, torch.full_like(x, -1.7)], dim=-1).reshape(-1, 3))[None]
    lifted = torch.tensor([[0.0, 0, 0.1, 0, 0, 0]])
    result = IcpLoss()(lifted, floor, floor, FINE)
    assert float(result.loss) == pytest.approx(0.1, abs=1e-3)
    assert float(result.parts["residual_m"]) == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize(("distance", "weight"), [(0.0, 1.0), (0.5, 0.36788), (1.0, 0.018316)])
def test_weighted_rho_matches_closed_form(distance, weight):
    rho = WeightedIcpLoss(sigma_m=0.5).rho(torch.tensor(0.2), torch.tensor(distance**2))
    assert float(rho) == pytest.approx(weight * 0.04, rel=1e-4)


def test_reprojection_by_identity_is_identity(pair):
    torch.testing.assert_close(reproject(se3.identity(1), pair[0], FINE), pair[0])


def test_reprojection_keeps_empty_pixels_empty():
    target = torch.zeros(1, 3, FINE.height, FINE.width)
    assert not reproject(se3.from_euler(torch.ones(1, 6)), target, FINE).any()


def test_reprojection_equals_vertex_map_of_transformed_points(pair):
    """The same image and the same gradient of the motion."""
    target = torch.cat([pair[1], pair[0] * (torch.rand(FINE.height, FINE.width) < 0.5)])
    weights = torch.randn(target.shape, generator=torch.Generator().manual_seed(0))
    images, gradients = [], []
    for way in ("map", "points"):
        parameters = torch.tensor([[0.3, 0.1, 0, 0, 0.01, 0.1], [0, 0, 0.2, 0.05, 0, -2.0]], requires_grad=True)
        T = se3.from_euler(parameters)
        if way == "map":
            image = reproject(T, target, FINE)
        else:
            points = se3.transform(T, target.flatten(2).mT)
            image = FINE.vertex_map(torch.where(activated(target).flatten(1)[..., None], points, 0.0))
        (image * weights).sum().backward()
        images.append(image.detach())
        gradients.append(parameters.grad)
    same = ((images[0] - images[1]).abs().amax(1) < 1e-4).float().mean()
    assert same > 0.999  # points exactly on a pixel's border may change sides
    torch.testing.assert_close(gradients[0], gradients[1], rtol=0.01, atol=0.01 * float(gradients[1].abs().max()))
