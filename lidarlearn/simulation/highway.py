"""The sparse scenery of a motorway."""

import numpy as np

from lidarlearn.simulation import objects
from lidarlearn.simulation.meshes import box, instances, merge, ribbon
from lidarlearn.simulation.site import Site, Street


def furnish_highway(site: Site) -> None:
    """Guard rails, reflector posts, signs, lamps, bridges, trees and bushes on the banks, noise barriers."""
    road = site.streets[0]
    _rails(site, road, 0.0, share=0.8)  # the central reserve
    for side in (-1, 1):
        _rails(site, road, side * (road.half_width + 0.9), share=0.35)
        _barriers(site, road, side)
        for spot in site.spots(road, side, 0.7, (48.0, 52.0)):
            site.place(objects.bollard(site.rng), spot.xy, 0.0, (0.3, 0.3), 0.2)
        for spot in site.spots(road, side, 3.0, (60.0, 220.0)):
            toward = spot.along if side < 0 else spot.along + np.pi
            site.place(objects.road_sign(site.rng), spot.xy, toward, (0.6, 4.0), 0.8)
        for spot in site.spots(road, side, 1.8, (70.0, 180.0)):
            site.place(objects.lamp(site.rng), spot.xy, spot.facing, (0.5, 0.5), 0.8)
    _across(site, road)
    _woods(site)


def _rails(site: Site, road: Street, offset: float, share: float) -> None:
    """Build a guard rail on posts along parts of the road."""
    line = road.offset(offset)
    start = 0
    while start < len(line) - 10:
        stop = min(len(line), start + int(site.rng.uniform(40, 160)))
        if site.rng.random() < share:
            points = site.raised(line[start:stop])
            posts = points[:: int(site.rng.choice([2, 4]))]
            site.add_world(merge([ribbon(points, 0.32, 0.45), instances(box(0.12, 0.12, 0.7), posts)]))
        start = stop


def _barriers(site: Site, road: Street, side: int) -> None:
    """Build a noise barrier of posts and panels along a short part of the road, or none."""
    rng = site.rng
    if rng.random() < 0.5:
        length = int(rng.uniform(60, 150))
        start = int(rng.uniform(0, max(1, len(road.centreline) - length)))
        line = road.offset(side * (road.half_width + 3.5))[start : start + length : 4]
        points = site.raised(line)
        height = rng.uniform(2.5, 4)
        site.add_world(merge([ribbon(points, height + 0.5, -0.5), instances(box(0.3, 0.3, height + 0.3), points)]))


def _across(site: Site, road: Street) -> None:
    """Build bridges and gantries over the road."""
    rng = site.rng
    along, _ = road.frames()
    place = rng.uniform(60, 160)
    while place < len(road.centreline):
        k = int(place)
        yaw = float(np.arctan2(along[k, 1], along[k, 0]))
        if rng.random() < 0.45:
            span, width, clear = 2 * road.half_width + 16, rng.uniform(6, 12), rng.uniform(5.0, 6.0)
            deck = box(width, span, 1.2, base=clear)
            parapets = [box(0.25, span, 1.0, base=clear + 1.2).moved(x=x) for x in (-width / 2, width / 2)]
            ends = [box(width, 3.0, clear + 1, base=-1.0).moved(y=side * (span / 2 - 1.5)) for side in (-1, 1)]
            piers = [box(1.0, 0.8, clear).moved(x=x) for x in (-width / 3, width / 3)]
            site.add(merge([deck, *parapets, *ends, *piers]), road.centreline[k], yaw + rng.uniform(-0.2, 0.2))
        else:
            site.add(objects.gantry(rng, 2 * road.half_width + 5), road.centreline[k], yaw)
        place += rng.uniform(140, 420)


def _woods(site: Site) -> None:
    """Plant clumps of trees and bushes on the banks, with open fields in between."""
    rng = site.rng
    trees = [objects.tree(rng) for _ in range(4)] + [objects.conifer(rng) for _ in range(2)]
    area = float(np.prod(site.high - site.low))
    clumps = rng.uniform(site.low, site.high, (int(area / 2200) + 1, 2))
    for mesh in trees:
        xy = np.repeat(clumps, 2, axis=0) + rng.normal(scale=9, size=(2 * len(clumps), 2))
        site.scatter(mesh, xy, rng.uniform(0.6, 1.3, len(xy)), 6.0)
    xy = np.repeat(clumps, 4, axis=0) + rng.normal(scale=12, size=(4 * len(clumps), 2))
    site.scatter(objects.bush(rng), xy, rng.uniform(0.7, 1.8, len(xy)), 3.0)
