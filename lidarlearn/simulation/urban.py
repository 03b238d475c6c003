"""The scenery of a town and of a campus."""

import numpy as np

from lidarlearn.simulation import objects
from lidarlearn.simulation.buildings import building, hall
from lidarlearn.simulation.meshes import Mesh
from lidarlearn.simulation.site import Site, Spot, Street


def furnish_town(site: Site) -> None:
    """Rows of houses with gardens behind walls, parked cars, trees, lamps and signs along every street."""
    trees = [objects.tree(site.rng) for _ in range(5)] + [objects.conifer(site.rng)]
    for street in site.streets:
        for side in (-1, 1):
            _signs(site, street, side)
            _parked_cars(site, street, side, share=site.rng.uniform(0.15, 0.7))
            _houses(site, street, side)
            _along(site, street, side, trees, beside=site.rng.uniform(1.2, 2.0), spacing=(9.0, 28.0))
            _along(site, street, side, trees, beside=site.rng.uniform(9, 14), spacing=(7.0, 30.0))
    _meadow(site, trees, density=1 / 260)


def furnish_campus(site: Site) -> None:
    """Large halls far apart on lawns, many trees, paths with benches and bollards."""
    trees = [objects.tree(site.rng) for _ in range(6)] + [objects.conifer(site.rng) for _ in range(2)]
    for street in site.streets:
        for side in (-1, 1):
            _signs(site, street, side)
            _halls(site, street, side)
            if street.half_width > 2.5:
                _parked_cars(site, street, side, share=site.rng.uniform(0.1, 0.4))
            _along(site, street, side, trees, beside=site.rng.uniform(1.5, 4), spacing=(8.0, 26.0))
            _along(site, street, side, trees, beside=site.rng.uniform(6, 16), spacing=(6.0, 24.0))
            _furniture(site, street, side)
    _meadow(site, trees, density=1 / 150)


def _houses(site: Site, street: Street, side: int) -> None:
    rng = site.rng
    pending = 0.0
    for spot in site.spots(street, side, 0.0, (3.0, 4.0)):
        if pending > 0:
            pending -= 3.5
            continue
        length, depth, height = rng.uniform(8, 24), rng.uniform(8, 13), rng.uniform(3.2, 13)
        setback = rng.choice([rng.uniform(2.4, 4), rng.uniform(4, 11)])
        xy = spot.xy + (setback + depth / 2) * spot.outward
        yaw = spot.facing + np.pi / 2 + rng.normal(scale=0.03)
        make = hall if rng.random() < 0.12 else building
        if site.place(make(rng, length, depth, height), xy, yaw, (length + 1, depth + 1.5), 2.0):
            if setback > 4.5:
                _garden(site, spot, length)
            pending = length + rng.choice([0.0, rng.uniform(1, 14)])


def _garden(site: Site, spot: Spot, length: float) -> None:
    rng = site.rng
    make = [objects.wall, objects.fence, objects.hedge][rng.integers(3)]
    extent = 0.7 * length
    site.place(make(rng, extent), spot.xy + 2.6 * spot.outward, spot.along, (extent, 0.8), 1.6)
    if rng.random() < 0.6:
        site.place(objects.bush(rng), spot.xy + rng.uniform(3.2, 4.4) * spot.outward, 0.0, (1.6, 1.6), 2.2)


def _halls(site: Site, street: Street, side: int) -> None:
    rng = site.rng
    for spot in site.spots(street, side, 0.0, (10.0, 30.0)):
        length, depth, height = rng.uniform(18, 50), rng.uniform(12, 22), rng.uniform(6, 20)
        xy = spot.xy + (rng.uniform(5, 22) + depth / 2) * spot.outward
        yaw = spot.facing + np.pi / 2 + rng.choice([0, 0, np.pi / 2, rng.uniform(-0.5, 0.5)])
        make = building if rng.random() < 0.75 else hall
        site.place(make(rng, length, depth, height), xy, yaw, (length + 2, depth + 3), 4.0)


def _parked_cars(site: Site, street: Street, side: int, share: float) -> None:
    """Park cars half on the pavement, in a share of the places."""
    rng = site.rng
    for spot in site.spots(street, side, 0.15, (6.0, 7.5)):
        if rng.random() < share:
            mesh = objects.van(rng) if rng.random() < 0.12 else objects.car(rng)
            yaw = spot.along + rng.choice([0, np.pi]) + rng.normal(scale=0.03)
            site.place(mesh, spot.xy + spot.outward * rng.uniform(0.75, 1.0), yaw, (5.0, 1.7), -0.35)


def _signs(site: Site, street: Street, side: int) -> None:
    rng = site.rng
    for spot in site.spots(street, side, 0.7, (20.0, 34.0)):
        site.place(objects.lamp(rng), spot.xy, spot.facing, (0.4, 0.4), 0.3)
    for spot in site.spots(street, side, 0.8, (15.0, 50.0)):
        mesh = [objects.sign, objects.bollard, objects.bin_or_box][rng.integers(3)](rng)
        site.place(mesh, spot.xy, spot.along, (0.6, 0.6), 0.3)


def _furniture(site: Site, street: Street, side: int) -> None:
    rng = site.rng
    for spot in site.spots(street, side, 1.2, (9.0, 30.0)):
        mesh = [objects.bench, objects.bollard, objects.bush, objects.bin_or_box][rng.integers(4)](rng)
        site.place(mesh, spot.xy, spot.facing, (1.2, 1.6), 0.2)


def _along(
    site: Site, street: Street, side: int, trees: list[Mesh], beside: float, spacing: tuple[float, float]
) -> None:
    for spot in site.spots(street, side, beside, spacing):
        xy = spot.xy + site.rng.normal(scale=0.3, size=2)
        site.place(trees[site.rng.integers(len(trees))], xy, site.rng.uniform(0, 2 * np.pi), (0.9, 0.9), 0.7)


def _meadow(site: Site, trees: list[Mesh], density: float) -> None:
    """Scatter trees and bushes over the remaining land, about `density` trees per square metre."""
    count = int(density * np.prod(site.high - site.low) / len(trees))
    for mesh in trees:
        xy = site.rng.uniform(site.low, site.high, (count, 2))
        site.scatter(mesh, xy, site.rng.uniform(0.6, 1.2, count), 6.0)
    xy = site.rng.uniform(site.low, site.high, (2 * count, 2))
    site.scatter(objects.bush(site.rng), xy, site.rng.uniform(0.6, 1.5, 2 * count), 3.5)
