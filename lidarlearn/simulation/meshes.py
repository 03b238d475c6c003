"""Triangle meshes in plain numpy: primitives, copies and unions. Sizes in metres, z up."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class Mesh:
    """Triangles that rays hit from either side.

    Args:
        vertices: corners of the triangles [m].
        triangles: indices of each triangle's corners.
    """

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> "Mesh":
        """A copy turned by `yaw` [rad] about z, then shifted [m]."""
        return instances(self, np.array([[x, y, z]]), np.array([yaw]))


def empty() -> Mesh:
    """A mesh without triangles."""
    return Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """The union of several meshes."""
    parts = list(meshes) or [empty()]
    counts = np.array([len(part.vertices) for part in parts])
    starts = np.cumsum(counts) - counts
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=True)]
    return Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(triangles))


def instances(
    mesh: Mesh,
    positions: Float[np.ndarray, "k 3"],
    yaws: Float[np.ndarray, "k"] | None = None,
    scales: Float[np.ndarray, "k 3"] | None = None,
) -> Mesh:
    """`k` copies of a mesh, each scaled along its own axes, rotated about z [rad] and shifted [m]."""
    yaws = np.zeros(len(positions)) if yaws is None else yaws
    scaled = mesh.vertices[None] * (np.ones((len(positions), 3)) if scales is None else scales)[:, None]
    cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
    x, y = cos * scaled[..., 0] - sin * scaled[..., 1], sin * scaled[..., 0] + cos * scaled[..., 1]
    vertices = np.stack([x, y, scaled[..., 2]], axis=-1) + positions[:, None]
    starts = len(mesh.vertices) * np.arange(len(positions))
    triangles = mesh.triangles[None] + starts[:, None, None]
    return Mesh(vertices.reshape(-1, 3), triangles.reshape(-1, 3))


def box(length: float, width: float, height: float, base: float = 0.0) -> Mesh:
    """A box centred on the z axis whose lower face lies at z = `base`; length along x, width along y."""
    corners = np.array([[x, y, z] for z in (0, 1) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))])
    faces = [(0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7)]
    for i in range(4):
        j = (i + 1) % 4
        faces += [(i, j, j + 4), (i, j + 4, i + 4)]
    return Mesh(corners * [length, width, height] + [0, 0, base], np.array(faces))


def cylinder(radius: float, height: float, sides: int = 8, top_radius: float | None = None, base: float = 0.0) -> Mesh:
    """A closed upright prism over a regular polygon at z = `base`, tapering to `top_radius`."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    top = radius if top_radius is None else top_radius
    lower = np.column_stack([ring * radius, np.full(sides, base)])
    upper = np.column_stack([ring * top, np.full(sides, base + height)])
    centres = [[0, 0, base], [0, 0, base + height]]
    i = np.arange(sides)
    j = (i + 1) % sides
    sheet = [np.stack([i, j, j + sides], -1), np.stack([i, j + sides, i + sides], -1)]
    below, above = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    lids = [np.stack([j, i, below], -1), np.stack([i + sides, j + sides, above], -1)]
    return Mesh(np.concatenate([lower, upper, centres]), np.concatenate(sheet + lids))


def extruded(outline: Float[np.ndarray, "n 2"], width: float, top_width: float | None = None) -> Mesh:
    """A body with the given outline in the x-z plane, symmetric in y.

    Args:
        outline: corners (x, z) of an outline that is star-shaped about their mean [m].
        width: extent in y at the lowest corner [m].
        top_width: extent in y at the highest corner, with linear interpolation in between [m]; None takes `width`.
    """
    n = len(outline)
    low, high = outline[:, 1].min(), outline[:, 1].max()
    share = (outline[:, 1] - low) / max(high - low, 1e-9)
    half = (width + share * ((width if top_width is None else top_width) - width)) / 2
    centre = outline.mean(axis=0)
    sides = []
    for sign in (-1.0, 1.0):
        ring = np.column_stack([outline[:, 0], sign * half, outline[:, 1]])
        sides.append(np.concatenate([ring, [[centre[0], sign * half.mean(), centre[1]]]]))
    i = np.arange(n)
    j = (i + 1) % n
    caps = [np.stack([i, j, 0 * i + n], -1), np.stack([j + n + 1, i + n + 1, 0 * i + 2 * n + 1], -1)]
    rim = [np.stack([i, i + n + 1, j + n + 1], -1), np.stack([i, j + n + 1, j], -1)]
    return Mesh(np.concatenate(sides), np.concatenate(caps + rim))


def leaves(rng: np.random.Generator, count: int, radii: tuple[float, float, float], leaf: float) -> Mesh:
    """Foliage: a porous ellipsoid of scattered triangles, denser towards its surface, centred at the origin.

    Args:
        rng: random generator of the leaves.
        count: number of triangles.
        radii: semi-axes of the ellipsoid [m].
        leaf: size of a triangle [m].
    """
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    centres = direction * rng.uniform(0.35, 1, (count, 1)) ** (1 / 2) * radii
    corners = centres[:, None] + rng.normal(scale=leaf / 2, size=(count, 3, 3))
    return Mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def ribbon(points: Float[np.ndarray, "n 3"], height: float, base: float = 0.0) -> Mesh:
    """An upright sheet without thickness along a line of points, from `base` to `base + height` above the line."""
    n = len(points)
    up = np.array([0, 0, 1.0])
    i = np.arange(n - 1)
    triangles = np.concatenate([np.stack([i, i + 1, i + 1 + n], -1), np.stack([i, i + 1 + n, i + n], -1)])
    return Mesh(np.concatenate([points + base * up, points + (base + height) * up]), triangles)


def sheet(points: Float[np.ndarray, "rows columns 3"], keep: np.ndarray | None = None) -> Mesh:
    """A surface through a grid of points.

    Args:
        points: the grid [m].
        keep: which of its (rows - 1) x (columns - 1) cells to keep; None keeps all.
    """
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    if keep is not None:
        a, b, c, d = a[keep], b[keep], c[keep], d[keep]
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=-2).reshape(-1, 3)
    used = np.unique(triangles)
    renumbered = np.zeros(rows * columns, dtype=np.int64)
    renumbered[used] = np.arange(len(used))
    return Mesh(points.reshape(-1, 3)[used], renumbered[triangles])
