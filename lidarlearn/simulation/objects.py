"""Objects of the simulated worlds. Every mesh stands at the origin on z = 0 and faces x."""

import numpy as np

from lidarlearn.simulation.meshes import Mesh, box, cylinder, extruded, instances, leaves, merge


def car(rng: np.random.Generator) -> Mesh:
    """A passenger car."""
    length, width, height = rng.uniform(3.8, 4.8), rng.uniform(1.7, 1.9), rng.uniform(1.4, 1.6)
    rear, bonnet = -length / 2, length / 2
    belt = 0.62 * height
    body = [(rear, 0.3), (rear, belt), (0.22 * length, belt), (bonnet, 0.5 * height), (bonnet, 0.3)]
    tail = rng.uniform(-0.48, -0.33) * length
    cabin = [(tail, belt), (tail + 0.1 * length, height), (0.08 * length, height), (0.25 * length, belt)]
    shell = [extruded(np.array(body), width), extruded(np.array(cabin), width * 0.95, width * 0.75)]
    return merge([*shell, _wheels(0.32, length, width)])


def van(rng: np.random.Generator) -> Mesh:
    """A delivery van."""
    length, width, height = rng.uniform(4.8, 6.0), rng.uniform(1.9, 2.1), rng.uniform(1.9, 2.6)
    front = length / 2
    nose = [(0.62 * front, height), (0.85 * front, 1.1), (front, 0.95), (front, 0.35)]
    outline = [(-front, 0.35), (-front, height), *nose]
    return merge([extruded(np.array(outline), width), _wheels(0.35, length, width)])


def lorry(rng: np.random.Generator) -> Mesh:
    """A lorry with a box body."""
    length = rng.uniform(8, 14)
    cab = box(2.2, 2.4, 2.6, base=0.5).moved(x=length / 2 - 1.1)
    body = box(length - 2.6, 2.5, 2.8, base=1.0).moved(x=-1.3)
    return merge([cab, body, _wheels(0.5, length, 2.4)])


def _wheels(radius: float, length: float, width: float) -> Mesh:
    """The four wheels of a vehicle of this length and width."""
    angle = 2 * np.pi * np.arange(8) / 8
    wheel = extruded(radius * np.stack([np.cos(angle), 1 + np.sin(angle)], axis=-1), 0.2)
    positions = [[i * 0.3 * length, j * (width / 2 - 0.12), 0.0] for i in (-1, 1) for j in (-1, 1)]
    return instances(wheel, np.array(positions))


def pedestrian(rng: np.random.Generator) -> Mesh:
    """A person in mid-stride."""
    height = rng.uniform(1.55, 1.9)
    stride = rng.uniform(0.03, 0.2)
    legs = [cylinder(0.09, 0.48 * height, 6).moved(x=sign * stride, y=sign * 0.1) for sign in (-1, 1)]
    torso = cylinder(0.17, 0.38 * height, 6, top_radius=0.24, base=0.46 * height)
    head = cylinder(0.1, 0.14 * height, 6, base=0.86 * height)
    return merge([*legs, torso, head])


def tree(rng: np.random.Generator) -> Mesh:
    """A broad-leaved tree: a trunk and a porous crown."""
    height = rng.uniform(5, 12)
    radius = 0.025 * height
    trunk = cylinder(radius, 0.6 * height, 7, top_radius=0.6 * radius)
    crowns = []
    for _ in range(3):
        radii = (rng.uniform(0.14, 0.26) * height, rng.uniform(0.14, 0.26) * height, rng.uniform(0.18, 0.3) * height)
        x, y, z = rng.uniform([-0.12, -0.12, 0.55], [0.12, 0.12, 0.75]) * height
        crowns.append(leaves(rng, 130, radii, 0.055 * height).moved(x, y, z))
    return merge([trunk, *crowns])


def conifer(rng: np.random.Generator) -> Mesh:
    """A spruce: layers of foliage almost down to the ground."""
    height = rng.uniform(6, 14)
    storeys = []
    for share in np.linspace(0.15, 0.9, 6):
        spread = (1.05 - share) * 0.26 * height
        storeys.append(leaves(rng, 60, (spread, spread, 0.09 * height), 0.05 * height).moved(z=share * height))
    return merge([cylinder(0.02 * height, 0.9 * height, 6, top_radius=0.02), *storeys])


def bush(rng: np.random.Generator) -> Mesh:
    """A shrub of one to two metres."""
    radii = (rng.uniform(0.5, 1.3), rng.uniform(0.5, 1.3), rng.uniform(0.5, 1.0))
    return leaves(rng, 150, radii, 0.28).moved(z=0.7 * radii[2])


def hedge(rng: np.random.Generator, length: float) -> Mesh:
    """A clipped hedge along x: a core with leaves sticking out."""
    height, width = rng.uniform(1.0, 2.0), rng.uniform(0.6, 1.0)
    count = int(40 * length)
    corner = rng.uniform(-0.5, 0.5, (count, 3)) * [length, 1.15 * width, 1.1 * height] + [0, 0, height / 2]
    corners = corner[:, None] + rng.normal(scale=0.1, size=(count, 3, 3))
    foliage = Mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))
    return merge([box(length, 0.9 * width, 0.95 * height), foliage])


def lamp(rng: np.random.Generator) -> Mesh:
    """A street lamp whose arm reaches out along x."""
    height = rng.uniform(5, 8)
    return merge([cylinder(0.09, height, 6, top_radius=0.05), box(1.6, 0.15, 0.1, base=height).moved(x=0.8)])


def sign(rng: np.random.Generator) -> Mesh:
    """A traffic sign whose board faces x."""
    size, height = rng.uniform(0.5, 0.9), rng.uniform(2.0, 2.5)
    return merge([cylinder(0.04, height + size, 5), box(0.03, size, size, base=height).moved(x=0.06)])


def road_sign(rng: np.random.Generator) -> Mesh:
    """A large motorway sign on two posts whose board faces x."""
    width, height = rng.uniform(2.5, 5), rng.uniform(1.5, 3)
    posts = [cylinder(0.08, 2.0 + height, 6).moved(y=side * width / 3) for side in (-1, 1)]
    return merge([*posts, box(0.06, width, height, base=2.0).moved(x=0.1)])


def gantry(rng: np.random.Generator, span: float) -> Mesh:
    """A sign gantry over a carriageway along x, `span` metres wide."""
    posts = [box(0.4, 0.4, 6.5).moved(y=side * span / 2) for side in (-1, 1)]
    boards = [box(0.15, 3.5, 2.2, base=5.4).moved(y=y) for y in (-0.22 * span, 0.22 * span)]
    return merge([*posts, box(0.5, span, 0.6, base=6.2), *boards])


def bollard(rng: np.random.Generator) -> Mesh:
    """A bollard or reflector post of about a metre."""
    return cylinder(rng.uniform(0.06, 0.12), rng.uniform(0.8, 1.1), 6)


def bin_or_box(rng: np.random.Generator) -> Mesh:
    """A waste bin, a switch cabinet or a letter box."""
    return box(rng.uniform(0.4, 0.7), rng.uniform(0.5, 1.3), rng.uniform(0.9, 1.4))


def bench(rng: np.random.Generator) -> Mesh:
    """A park bench facing x."""
    length = rng.uniform(1.5, 2.2)
    legs = [box(0.4, 0.08, 0.42).moved(y=side * 0.42 * length) for side in (-1, 1)]
    return merge([*legs, box(0.45, length, 0.06, base=0.42), box(0.06, length, 0.4, base=0.5).moved(x=-0.22)])


def wall(rng: np.random.Generator, length: float) -> Mesh:
    """A garden wall along x, with pillars."""
    height = rng.uniform(0.8, 2.2)
    pillars = [box(0.4, 0.45, height + 0.2).moved(x=x) for x in np.arange(-length / 2, length / 2 + 0.1, 3.0)]
    return merge([box(length, 0.25, height), *pillars])


def fence(rng: np.random.Generator, length: float) -> Mesh:
    """A picket fence along x."""
    height, spacing = rng.uniform(0.9, 1.6), rng.uniform(0.25, 0.5)
    xs = np.arange(-length / 2, length / 2, spacing)
    positions = np.column_stack([xs, np.zeros((len(xs), 2))])
    pales = instances(box(0.1, 0.04, height), positions)
    return merge([pales, box(length, 0.05, 0.1, base=0.3), box(length, 0.05, 0.1, base=height - 0.2)])
