"""Surface normals from the moments of neighbouring points: in a vertex map, or in any neighbourhood of a map."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from lidarlearn.geometry.projection import activated


@dataclass(frozen=True)
class PlaneFit:
    """Planes through sets of points, from their covariances.

    Args:
        normals: unit vectors of the smallest eigenvalue, sign arbitrary.
        variances: the three eigenvalues in ascending order [m^2]: across the plane, then along it.
    """

    normals: Float[Tensor, "*batch 3"]
    variances: Float[Tensor, "*batch 3"]


def fit_planes(covariances: Float[Tensor, "*batch 6"]) -> PlaneFit:
    """Least-squares planes from covariances given by their components (xx, xy, xz, yy, yz, zz).

    Closed form and branch-free, so it runs at memory speed on both devices where a batched eigensolver does not: the
    adjugate has the same eigenvectors with eigenvalues l1 l2 >> l0 l2 >= l0 l1, so a few squarings leave the normal
    alone. The error is (l0 / l1)^8: nothing for a plane, and a set without a plane has no normal to be wrong about.
    """
    trace = covariances[..., 0] + covariances[..., 3] + covariances[..., 5]
    scale = trace.clamp(min=torch.finfo(trace.dtype).tiny)[..., None]
    adjugate = power = _adjugate(covariances / scale)
    for _ in range(3):
        power = _square(power)
        size = power.abs().amax(-1, keepdim=True).clamp(min=torch.finfo(trace.dtype).tiny)
        power = power / size
    normals = _longest_column(power)
    normals = normals / normals.norm(dim=-1, keepdim=True).clamp(min=torch.finfo(trace.dtype).tiny)
    l0 = (_multiply(covariances / scale, normals) * normals).sum(-1).clamp(min=0)
    rest = (1 - l0).clamp(min=0)
    product = (adjugate[..., 0] + adjugate[..., 3] + adjugate[..., 5] - l0 * rest).clamp(min=0)
    root = (rest * rest - 4 * product).clamp(min=0).sqrt()
    l2 = (rest + root) / 2
    l1 = product / l2.clamp(min=torch.finfo(trace.dtype).tiny)
    return PlaneFit(normals, torch.stack([l0, l1, l2], dim=-1) * scale)


def normal_map(
    vertex_map: Float[Tensor, "*batch 3 h w"],
    window: tuple[int, int] = (3, 5),
    max_range_jump: float = 0.1,
    max_roughness: float = 0.5,
) -> Float[Tensor, "*batch 3 h w"]:
    """Unit normals from the activated pixels around each pixel, pointing towards the sensor, zeros where undefined.

    Moments are taken relative to the pixel's own point, so float32 loses nothing at long range. A normal needs four
    neighbours, some of them in other rows and some in other columns (a single line of points lies in any plane), and
    no depth jump among those used.

    Args:
        vertex_map: points [m] in the sensor frame, zeros where no point fell.
        window: rows and columns of the neighbourhood [px], odd; columns wrap at the seam.
        max_range_jump: neighbours count if their range differs by less than this share of the pixel's own range.
        max_roughness: largest accepted ratio of the deviation from the plane to the patch's smaller extent in it;
            generous, because poles and trunks are no planes but hold a car's motion along the road.

    Source: Dellenbach et al. 2021, III-A "Local map and neighborhood".
    """
    count, rows, columns, first, second = _window_moments(vertex_map, window, max_range_jump)
    n = count.clamp(min=1)[..., None]
    mean = first / n
    x, y, z = mean.unbind(-1)
    covariances = second / n - torch.stack([x * x, x * y, x * z, y * y, y * z, z * z], dim=-1)
    plane = fit_planes(covariances)
    across, along = plane.variances[..., 0], plane.variances[..., 1]
    spans_patch = (rows >= 2) & (columns >= 2)
    defined = (count >= 5) & spans_patch & (along > 0) & (across <= max_roughness**2 * along) & activated(vertex_map)
    points = vertex_map.movedim(-3, -1)
    towards = torch.where((plane.normals * points).sum(-1) > 0, -1.0, 1.0)
    normals = plane.normals * (towards * defined)[..., None]
    return normals.movedim(-1, -3)


def _window_moments(
    vertex_map: Float[Tensor, "*batch 3 h w"], window: tuple[int, int], max_range_jump: float
) -> tuple[Tensor, Tensor, Tensor, Float[Tensor, "*batch h w 3"], Float[Tensor, "*batch h w 6"]]:
    """Count of the neighbours (all, in other rows, in other columns), sum and sum of products of their offsets.

    The centre itself is counted among all, at offset zero.
    """
    rows, columns = window[0] // 2, window[1] // 2
    h, w = vertex_map.shape[-2:]
    batch = vertex_map.shape[:-3]
    ranges = vertex_map.norm(dim=-3, keepdim=True)
    image = torch.cat([vertex_map, ranges], dim=-3).reshape(-1, 4, h, w)
    padded = pad(pad(image, (columns, columns, 0, 0), mode="circular"), (0, 0, rows, rows))
    tolerance = max_range_jump * image[:, 3]
    sums = image.new_zeros(12, *image[:, 0].shape)
    sums[0] = 1
    for row in range(2 * rows + 1):
        for column in range(2 * columns + 1):
            if (row, column) == (rows, columns):
                continue
            neighbour = padded[:, :, row : row + h, column : column + w]
            used = ((neighbour[:, 3] - image[:, 3]).abs() < tolerance) & (neighbour[:, 3] > 0)
            terms = (used, used * (row != rows), used * (column != columns))
            dx, dy, dz = ((neighbour[:, :3] - image[:, :3]) * used[:, None]).unbind(1)
            for i, term in enumerate((*terms, dx, dy, dz, dx * dx, dx * dy, dx * dz, dy * dy, dy * dz, dz * dz)):
                sums[i] += term
    sums = sums.movedim(0, -1).reshape(*batch, h, w, 12)
    return sums[..., 0], sums[..., 1], sums[..., 2], sums[..., 3:6], sums[..., 6:]


def _adjugate(s: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 6"]:
    """Adjugate of a symmetric 3x3 matrix, both by their components (xx, xy, xz, yy, yz, zz)."""
    xx, xy, xz, yy, yz, zz = s.unbind(-1)
    return torch.stack(
        [
            yy * zz - yz * yz,
            xz * yz - xy * zz,
            xy * yz - xz * yy,
            xx * zz - xz * xz,
            xy * xz - xx * yz,
            xx * yy - xy * xy,
        ],
        dim=-1,
    )


def _square(s: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 6"]:
    """Square of a symmetric 3x3 matrix, both by their components."""
    xx, xy, xz, yy, yz, zz = s.unbind(-1)
    return torch.stack(
        [
            xx * xx + xy * xy + xz * xz,
            xx * xy + xy * yy + xz * yz,
            xx * xz + xy * yz + xz * zz,
            xy * xy + yy * yy + yz * yz,
            xy * xz + yy * yz + yz * zz,
            xz * xz + yz * yz + zz * zz,
        ],
        dim=-1,
    )


def _multiply(s: Float[Tensor, "*batch 6"], v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Symmetric 3x3 matrix, by its components, times a vector."""
    xx, xy, xz, yy, yz, zz = s.unbind(-1)
    x, y, z = v.unbind(-1)
    return torch.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z], dim=-1)


def _longest_column(s: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 3"]:
    """The column with the largest diagonal element of a symmetric 3x3 matrix of rank one."""
    xx, xy, xz, yy, yz, zz = s.unbind(-1)
    x_longest: Bool[Tensor, "*batch"] = (xx >= yy) & (xx >= zz)
    y_longest: Bool[Tensor, "*batch"] = yy >= zz
    y_or_z = torch.where(y_longest[..., None], torch.stack([xy, yy, yz], dim=-1), torch.stack([xz, yz, zz], dim=-1))
    return torch.where(x_longest[..., None], torch.stack([xx, xy, xz], dim=-1), y_or_z)
