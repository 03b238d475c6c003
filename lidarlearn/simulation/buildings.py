"""Buildings with recessed windows, bays, balconies, steps and roofs, so that facades have relief."""

import numpy as np

from lidarlearn.simulation.meshes import Mesh, box, cylinder, instances, merge


def building(rng: np.random.Generator, length: float, depth: float, height: float) -> Mesh:
    """A house centred at the origin, with its front (bay windows, balconies and a door) towards -y.

    Args:
        rng: random generator of the details.
        length: extent along x [m].
        depth: extent along y [m].
        height: height of the eaves [m].
    """
    floors = max(1, round(height / 3.0))
    recess, bay = rng.uniform(0.12, 0.4), rng.uniform(2.4, 4.0)
    window = (rng.uniform(0.35, 0.65), rng.uniform(0.4, 0.65))
    walls = []
    for yaw, width, distance in (
        (0.0, length, depth / 2),
        (np.pi, length, depth / 2),
        (np.pi / 2, depth, length / 2),
        (-np.pi / 2, depth, length / 2),
    ):
        facade = _facade(width, height, max(1, round(width / bay)), floors, recess, window)
        walls.append(facade.moved(y=-distance).moved(yaw=yaw))
    plinth = box(length + 0.1, depth + 0.1, 3.0, base=-2.5)  # reaches below sloping ground
    return merge([*walls, plinth, _roof(rng, length, depth, height), *_front(rng, length, depth, height, floors)])


def hall(rng: np.random.Generator, length: float, depth: float, height: float) -> Mesh:
    """A plain hall with pilasters, such as a workshop, a sports hall or a supermarket."""
    spacing = rng.uniform(4, 7)
    xs = np.arange(-length / 2 + 0.3, length / 2, spacing)
    pilasters = [box(0.5, depth + 0.7, height).moved(x=x) for x in xs]
    gate = box(rng.uniform(3, 5), 0.8, 0.2, base=3.2).moved(y=-depth / 2)
    return merge([box(length, depth, height + 2.5, base=-2.5), *pilasters, gate])


def _facade(width: float, height: float, bays: int, floors: int, recess: float, window: tuple[float, float]) -> Mesh:
    """A wall in the x-z plane with windows set back by `recess` towards +y; `window` is their share of a cell."""
    cell = _window_cell(recess, window)
    cell_width, cell_height = width / bays, height / floors
    column, floor = np.meshgrid(np.arange(bays), np.arange(floors))
    xs, zs = (column.ravel() + 0.5) * cell_width - width / 2, floor.ravel() * cell_height
    positions = np.column_stack([xs, np.zeros_like(xs), zs])
    scales = np.tile([cell_width, 1.0, cell_height], (len(xs), 1))
    return instances(cell, positions, scales=scales)


def _window_cell(recess: float, window: tuple[float, float]) -> Mesh:
    """A unit-sized piece of wall around one window: frame, reveals and pane."""
    half, low, high = window[0] / 2, 0.25, 0.25 + window[1]
    square = np.array([[-0.5, 0.0], [0.5, 0.0], [0.5, 1.0], [-0.5, 1.0]])
    inner = np.array([[-half, low], [half, low], [half, high], [-half, high]])
    rings = [(square, 0.0), (inner, 0.0), (inner, recess)]
    vertices = np.concatenate([np.column_stack([ring[:, 0], np.full(4, y), ring[:, 1]]) for ring, y in rings])
    triangles = [(8, 9, 10), (8, 10, 11)]
    for start in (0, 4):
        for i in range(4):
            j = (i + 1) % 4
            triangles += [(start + i, start + j, start + 4 + j), (start + i, start + 4 + j, start + 4 + i)]
    return Mesh(vertices, np.array(triangles))


def _roof(rng: np.random.Generator, length: float, depth: float, height: float) -> Mesh:
    """A flat roof with a parapet, or a gable along x with eaves and a chimney."""
    if rng.random() < 0.35:
        return box(length + 0.3, depth + 0.3, 0.5, base=height)
    rise, eaves = depth * rng.uniform(0.25, 0.45), 0.4
    ridge = np.array([[-0.5, 0.0, rise], [0.5, 0.0, rise]]) * [length + 2 * eaves, 1, 1]
    side = (depth / 2 + eaves) * np.array([0, 1.0, 0]) * [[-1], [1]]
    corners = [[sx * (length / 2 + eaves), y, 0.0] for y in side[:, 1] for sx in (-1, 1)]
    vertices = np.concatenate([ridge, np.array(corners)])
    vertices[:, 2] += height
    triangles = np.array([(0, 2, 3), (0, 3, 1), (0, 4, 5), (0, 5, 1), (0, 2, 4), (1, 3, 5)])
    chimney = box(0.6, 0.6, rise + 0.8, base=height).moved(x=length * rng.uniform(-0.35, 0.35), y=0.1 * depth)
    return merge([Mesh(vertices, triangles), chimney])


def _front(rng: np.random.Generator, length: float, depth: float, height: float, floors: int) -> list[Mesh]:
    """The projecting parts of a front: gutters, steps, a porch, a bay window, balconies."""
    parts = [cylinder(0.06, height, 6).moved(x=side * (length / 2 - 0.3), y=-depth / 2 - 0.08) for side in (-1, 1)]
    door = rng.uniform(-0.35, 0.35) * length
    parts.append(box(1.8, 1.0, 0.35).moved(x=door, y=-depth / 2 - 0.5))
    if rng.random() < 0.5:
        parts.append(box(2.0, 1.2, 0.15, base=2.4).moved(x=door, y=-depth / 2 - 0.6))
    if rng.random() < 0.5:
        bay_width = rng.uniform(1.6, 3.0)
        bay = box(bay_width, 1.2, min(height, rng.uniform(2.6, 6.0)))
        parts.append(bay.moved(x=-np.sign(door) * rng.uniform(0.15, 0.3) * length, y=-depth / 2 - 0.4))
    for floor in range(1, floors):
        if rng.random() < 0.5:
            balcony = box(rng.uniform(2, 4), 1.1, 1.1, base=floor * height / floors - 0.1)
            parts.append(balcony.moved(x=rng.uniform(-0.3, 0.3) * length, y=-depth / 2 - 0.5))
    return parts
