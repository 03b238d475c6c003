"""The site of a world: streets, the ground around them, and everything built on it."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from lidarlearn.simulation.meshes import Mesh, instances, merge, sheet
from lidarlearn.simulation.terrain import Terrain


@dataclass(frozen=True)
class Street:
    """A road or a footway.

    Args:
        centreline: points of the centreline, about 1 m apart [m].
        half_width: half the width of the carriageway [m].
    """

    centreline: Float[np.ndarray, "n 2"]
    half_width: float

    def frames(self) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
        """Unit vectors along the street and to its left at each point of the centreline."""
        along = np.gradient(self.centreline, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True).clip(1e-9)
        return along, np.stack([-along[:, 1], along[:, 0]], axis=-1)

    def offset(self, distance: float) -> Float[np.ndarray, "n 2"]:
        """The line `distance` metres to the left of the centreline."""
        return self.centreline + distance * self.frames()[1]


@dataclass(frozen=True)
class Profile:
    """The cross-section of a street and of the ground beside it.

    Args:
        kerb: step up at the edge of the carriageway [m]; negative for a shoulder that falls off.
        bank: height of the banks beside the road, which rise and fall [m].
        bank_start: distance from the edge of the carriageway to the banks [m].
        roughness: standard deviation of the height of the ground off the road [m].
    """

    kerb: float
    bank: float
    bank_start: float
    roughness: float


@dataclass(frozen=True)
class Spot:
    """A place beside a street: its position [m], the direction of the street and the direction towards it [rad]."""

    xy: Float[np.ndarray, "2"]
    along: float
    facing: float

    @property
    def outward(self) -> Float[np.ndarray, "2"]:
        """Unit vector away from the street."""
        return -np.array([np.cos(self.facing), np.sin(self.facing)])


class Site:
    """Land with streets, on which a world is built.

    Args:
        rng: random generator of everything placed at random.
        terrain: the smooth ground.
        streets: all streets; the drive follows the first one.
        profile: cross-section of the streets.
    """

    _CELL = 0.5  # edge of a cell of the grid of occupied ground [m]
    _FINE_WIDTH = 7.0  # distance from the edge of a street up to which the mesh of the ground is fine [m]

    def __init__(self, rng: np.random.Generator, terrain: Terrain, streets: list[Street], profile: Profile) -> None:
        self.rng, self.terrain, self.streets, self.profile = rng, terrain, streets, profile
        points = np.concatenate([street.centreline for street in streets])
        self._widths = np.concatenate([np.full(len(street.centreline), street.half_width) for street in streets])
        self._tree = cKDTree(points)
        margin = 90.0
        self.low, self.high = points.min(axis=0) - margin, points.max(axis=0) + margin
        self._occupied = np.zeros(np.ceil((self.high - self.low) / self._CELL).astype(int) + 1, dtype=bool)
        self._banks = rng.uniform(0, 2 * np.pi, (2, 4))
        self._meshes: list[Mesh] = []

    def beside(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Distance from the edge of the nearest carriageway [m]; negative on the carriageway."""
        distance, nearest = self._tree.query(xy)
        return distance - self._widths[nearest]

    def ground(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Height of the ground including kerbs and banks [m]."""
        return self.terrain.height(xy) + self._relief(xy, self.beside(xy))

    def raised(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """The points, raised to the height of the ground."""
        return np.column_stack([xy, self.ground(xy)])

    def _relief(self, xy: Float[np.ndarray, "n 2"], beside: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        kerb = self.profile.kerb * np.clip(beside / 0.3, 0, 1)
        rise = np.clip((beside - self.profile.bank_start) / 12.0, 0, 1)
        wave = np.sin(xy @ (np.array([[0.021, 0.013], [-0.017, 0.024]])) + self._banks[0, :2]).sum(axis=-1)
        return kerb + self.profile.bank * rise * rise * (3 - 2 * rise) * (0.35 + wave)

    def _surface(self, cell: float, nearest: float, farthest: float, sunk: float) -> Mesh:
        """The ground within a range of distances from the edge of a street, lowered by `sunk` near the streets."""
        axes = [np.arange(self.low[k], self.high[k], cell) for k in (0, 1)]
        xy = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        reach = farthest + self._widths.max()
        distance, street = self._tree.query(xy, distance_upper_bound=reach)
        beside = distance - np.append(self._widths, 0)[street]
        inside = (beside >= nearest) & (beside <= farthest) & np.isfinite(distance)
        keep = inside[:-1, :-1] & inside[1:, :-1] & inside[:-1, 1:] & inside[1:, 1:]
        rough = (
            self.profile.roughness * self.rng.standard_normal(inside.sum()) * np.clip(beside[inside] / 1.5 - 1, 0, 1)
        )
        z = np.zeros(inside.shape)
        z[inside] = self.terrain.height(xy[inside]) + self._relief(xy[inside], beside[inside]) + rough
        z[inside] -= sunk * (beside[inside] < self._FINE_WIDTH)
        return sheet(np.concatenate([xy, z[..., None]], axis=-1), keep)

    def spots(self, street: Street, side: int, beside: float, spacing: tuple[float, float]) -> Iterator[Spot]:
        """Places along one side of a street, `beside` metres from its edge, at random intervals."""
        along, left = street.frames()
        i = self.rng.uniform(0, spacing[0])
        while i < len(left):
            k = int(i)
            xy = street.centreline[k] + side * (street.half_width + beside) * left[k]
            heading = float(np.arctan2(along[k, 1], along[k, 0]))
            yield Spot(xy, heading, heading - side * np.pi / 2)
            i += self.rng.uniform(*spacing)

    def place(
        self, mesh: Mesh, xy: Float[np.ndarray, "2"], yaw: float, size: tuple[float, float], clearance: float
    ) -> bool:
        """Build an object if the ground is free.

        Args:
            mesh: the object.
            xy: position of its origin [m].
            yaw: rotation about z [rad].
            size: extent of its footprint along its own x and y axes [m].
            clearance: least distance from the edge of any carriageway [m].

        Returns:
            Whether it was built.
        """
        cells = self._footprint(xy, yaw, size)
        if cells is None or self._occupied[cells[:, 0], cells[:, 1]].any():
            return False
        if self.beside(cells * self._CELL + self.low).min() < clearance:
            return False
        self._occupied[cells[:, 0], cells[:, 1]] = True
        self.add(mesh, xy, yaw)
        return True

    def add(self, mesh: Mesh, xy: Float[np.ndarray, "2"], yaw: float) -> None:
        """Build an object whether or not the ground is free."""
        self._meshes.append(mesh.moved(xy[0], xy[1], self.ground(xy[None])[0], yaw))

    def add_world(self, mesh: Mesh) -> None:
        """Build an object whose vertices are in the world frame."""
        self._meshes.append(mesh)

    def scatter(
        self, mesh: Mesh, xy: Float[np.ndarray, "n 2"], scales: Float[np.ndarray, "n"], clearance: float
    ) -> None:
        """Build copies of an object, except on occupied ground or closer than `clearance` [m] to a carriageway."""
        cells = np.floor((xy - self.low) / self._CELL).astype(int)
        cells = cells.clip(0, np.array(self._occupied.shape) - 1)
        free = (self.beside(xy) > clearance) & ~self._occupied[cells[:, 0], cells[:, 1]]
        xy, scales = xy[free], scales[free]
        if len(xy):
            yaws = self.rng.uniform(0, 2 * np.pi, len(xy))
            self._meshes.append(instances(mesh, self.raised(xy), yaws, np.repeat(scales[:, None], 3, axis=1)))

    def _footprint(self, xy: np.ndarray, yaw: float, size: tuple[float, float]) -> np.ndarray | None:
        """Grid cells below a rotated rectangle; None if it is not entirely on the site."""
        x, y = (np.linspace(-extent / 2, extent / 2, int(extent / self._CELL) + 2) for extent in size)
        x, y = (axis.ravel() for axis in np.meshgrid(x, y))
        turned = np.stack([np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y], axis=-1)
        cells = np.floor((turned + xy - self.low) / self._CELL).astype(int)
        outside = (cells < 0).any() or (cells >= self._occupied.shape).any()
        return None if outside else cells

    def mesh(self) -> Mesh:
        """Everything built, and the ground: fine on and near the streets, because of the kerbs; coarse elsewhere."""
        fine = self._surface(0.6, -np.inf, self._FINE_WIDTH, sunk=0.0)
        # Coarse triangles continue below the fine ones, so that no ray passes between them.
        rest = self._surface(5.0, self._FINE_WIDTH - 1.5 * 5.0, np.inf, sunk=0.08)
        return merge([*self._meshes, fine, rest])
