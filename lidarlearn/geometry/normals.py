"""Surface normals from the moments of neighbouring points, in a vertex map or anywhere else."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from lidarlearn.geometry.ranges import squared_ranges

_Symmetric = tuple[Tensor, ...]  # components xx, xy, xz, yy, yz, zz of symmetric 3x3 matrices
_Vector = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class PlaneFit:
    """Least-squares planes through sets of points.

    Args:
        normals: unit eigenvectors with the smallest eigenvalue, of arbitrary sign.
        variances: the three eigenvalues of the covariance in ascending order [m^2]: across the plane, then along it.
    """

    normals: Float[Tensor, "*batch 3"]
    variances: Float[Tensor, "*batch 3"]


def fit_planes(covariances: Float[Tensor, "*batch 6"]) -> PlaneFit:
    """Least-squares planes from the components (xx, xy, xz, yy, yz, zz) of covariances.

    In closed form and without branches, so it runs at memory speed on CPU and GPU; a batched eigensolver does not. The
    adjugate has the same eigenvectors with the eigenvalues l1 l2 >> l0 l2 >= l0 l1, so after squaring it a few times
    only the normal is left. The error is (l0 / l1)^8, negligible for a plane. Components are separate tensors, fastest
    if each is contiguous in memory, and fused into one pass by a compiler.
    """
    normal, variances = _fit(covariances.unbind(-1))
    return PlaneFit(torch.stack(normal).movedim(0, -1), torch.stack(variances).movedim(0, -1))


def covariances_of(
    means: Float[Tensor, "*batch 3"], square_means: Float[Tensor, "*batch 6"]
) -> Float[Tensor, "*batch 6"]:
    """Covariances [m^2] from the means of x, y, z [m] and of their products [m^2], in the order of `fit_planes`."""
    x, y, z = means.unbind(-1)
    return square_means - torch.stack([x * x, x * y, x * z, y * y, y * z, z * z], dim=-1)


def _fit(s: _Symmetric) -> tuple[_Vector, _Vector]:
    """Components of the normals and variances, see `fit_planes`."""
    tiny = torch.finfo(s[0].dtype).tiny
    scale = (s[0] + s[3] + s[5]).clamp(min=tiny)
    s = tuple(component / scale for component in s)
    adjugate = power = _adjugate(s)
    for _ in range(3):
        power = _square(power)
        # the largest component of a matrix without negative eigenvalues is on its diagonal
        inverse_size = 1 / torch.maximum(torch.maximum(power[0], power[3]), power[5]).clamp(min=tiny)
        power = tuple(component * inverse_size for component in power)
    x, y, z = _longest_column(power)
    inverse_length = torch.rsqrt((x * x + y * y + z * z).clamp(min=tiny))
    normal = (x * inverse_length, y * inverse_length, z * inverse_length)
    along_x, along_y, along_z = _multiply(s, normal)
    l0 = (along_x * normal[0] + along_y * normal[1] + along_z * normal[2]).clamp(min=0)
    rest = (1 - l0).clamp(min=0)
    product = (adjugate[0] + adjugate[3] + adjugate[5] - l0 * rest).clamp(min=0)
    root = (rest * rest - 4 * product).clamp(min=0).sqrt()
    l2 = (rest + root) / 2
    l1 = product / l2.clamp(min=tiny)
    return normal, (l0 * scale, l1 * scale, l2 * scale)


def normal_map(
    vertex_map: Float[Tensor, "*batch 3 h w"],
    window: tuple[int, int] = (3, 5),
    max_range_jump: float = 0.1,
    max_roughness: float = 0.5,
) -> Float[Tensor, "*batch 3 h w"]:
    """Unit normals from the activated pixels around each pixel, pointing towards the sensor, zeros where undefined.

    Moments are relative to the pixel's own point, so that float32 is exact enough at long range. A normal needs four
    neighbours without a depth jump, some in other rows and some in other columns: a single line of points lies in many
    planes.

    Args:
        vertex_map: points [m] in the sensor frame, zeros where no point fell.
        window: rows and columns of the neighbourhood [px], odd; columns wrap at the seam.
        max_range_jump: neighbours are used if their range differs by less than this share of the pixel's own range.
        max_roughness: largest accepted deviation from the plane, relative to the smaller extent in it. Generous: poles
            and trunks are no planes, but they determine a car's motion along the road.

    Source: Dellenbach et al. 2021, III-A "Local map and neighborhood".
    """
    channels = vertex_map.contiguous().movedim(-3, 0)
    sums = _window_moments(channels, window, max_range_jump)
    beside, above, diagonal = sums.counts
    count = 1 + beside + above + diagonal
    (x, y, z), (xx, yy, zz) = sums.first / count, sums.squares / count
    (xy, xz), yz = sums.xy_xz / count, sums.yz / count
    normal, (across, along, _) = _fit((xx - x * x, xy - x * y, xz - x * z, yy - y * y, yz - y * z, zz - z * z))
    spans_patch = (above + diagonal >= 2) & (beside + diagonal >= 2)
    defined = (count >= 5) & spans_patch & (along > 0) & (across <= max_roughness**2 * along)
    normals = torch.stack(normal)
    away = (normals * channels).sum(0) > 0
    normals = normals * torch.where(away, -1.0, 1.0).to(normals.dtype) * defined
    return normals.movedim(0, -3)


@dataclass(frozen=True)
class _Moments:
    """Moments of the used neighbours of each pixel, relative to its own point.

    Args:
        counts: number of neighbours in the same row, in the same column, and in neither.
        first: sums of x, y, z.
        squares: sums of xx, yy, zz.
        xy_xz: sums of xy, xz.
        yz: sum of yz.
    """

    counts: list[Float[Tensor, "*batch h w"]]
    first: Float[Tensor, "3 *batch h w"]
    squares: Float[Tensor, "3 *batch h w"]
    xy_xz: Float[Tensor, "2 *batch h w"]
    yz: Float[Tensor, "*batch h w"]


def _window_moments(
    channels: Float[Tensor, "3 *batch h w"], window: tuple[int, int], max_range_jump: float
) -> _Moments:
    rows, columns = window[0] // 2, window[1] // 2
    h, w = channels.shape[-2:]
    ranges = squared_ranges(channels.movedim(0, -1)).sqrt_()
    ranges = torch.where(ranges > 0, ranges, torch.inf)  # so that empty pixels have no neighbours
    neighbours, neighbours_ranges = _padded(channels, rows, columns, 0.0), _padded(ranges, rows, columns, torch.inf)
    tolerance = max_range_jump * ranges
    # Separate tensors: for an in-place sum into a part of a tensor, a compiler copies all of it.
    counts, yz = [torch.zeros_like(ranges) for _ in range(3)], torch.zeros_like(ranges)
    first, squares, xy_xz = (torch.zeros_like(part) for part in (channels, channels, channels[1:]))
    for row in range(2 * rows + 1):
        for column in range(2 * columns + 1):
            if (row, column) == (rows, columns):
                continue
            part = (..., slice(row, row + h), slice(column, column + w))
            used = (neighbours_ranges[part] - ranges).abs_().lt_(tolerance)  # 1 or 0
            counts[0 if row == rows else 1 if column == columns else 2] += used
            d = (neighbours[part] - channels).mul_(used)
            first += d
            squares.addcmul_(d, d)
            xy_xz.addcmul_(d[:1], d[1:])
            yz.addcmul_(d[1], d[2])
    return _Moments(counts, first, squares, xy_xz, yz)


def _padded(
    images: Float[Tensor, "*channels h w"], rows: int, columns: int, value: float
) -> Float[Tensor, "*channels padded_h padded_w"]:
    """Pad with a value above and below, and with the columns from the other side of the seam at the sides."""
    wrapped = torch.cat([images[..., images.shape[-1] - columns :], images, images[..., :columns]], dim=-1)
    return pad(wrapped, (0, 0, rows, rows), value=value)


def _adjugate(s: _Symmetric) -> _Symmetric:
    xx, xy, xz, yy, yz, zz = s
    return (
        yy * zz - yz * yz,
        xz * yz - xy * zz,
        xy * yz - xz * yy,
        xx * zz - xz * xz,
        xy * xz - xx * yz,
        xx * yy - xy * xy,
    )


def _square(s: _Symmetric) -> _Symmetric:
    xx, xy, xz, yy, yz, zz = s
    xy_xy, xz_xz, yz_yz = xy * xy, xz * xz, yz * yz
    return (
        xx * xx + xy_xy + xz_xz,
        xx * xy + xy * yy + xz * yz,
        xx * xz + xy * yz + xz * zz,
        xy_xy + yy * yy + yz_yz,
        xy * xz + yy * yz + yz * zz,
        xz_xz + yz_yz + zz * zz,
    )


def _multiply(s: _Symmetric, v: _Vector) -> _Vector:
    xx, xy, xz, yy, yz, zz = s
    x, y, z = v
    return xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z


def _longest_column(s: _Symmetric) -> _Vector:
    """The column with the largest diagonal element; of a matrix of rank one it is the longest."""
    xx, xy, xz, yy, yz, zz = s
    x_longest, y_longest = (xx >= yy) & (xx >= zz), yy >= zz
    return (
        torch.where(x_longest, xx, torch.where(y_longest, xy, xz)),
        torch.where(x_longest, xy, torch.where(y_longest, yy, yz)),
        torch.where(x_longest, xz, torch.where(y_longest, yz, zz)),
    )
