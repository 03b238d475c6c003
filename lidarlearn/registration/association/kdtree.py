"""Exact nearest neighbours by a KdTree."""

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from lidarlearn.registration.association.base import Neighbours
from lidarlearn.registration.association.voxel_map_association import VoxelMapAssociation

# Beyond the search distance: a point without a neighbour is searched again once it has moved this far.
_SEARCH_MARGIN_M = 0.1
_MIN_PARALLEL_QUERIES = 1000  # fewer are answered before a second thread has started
_LEAF_SIZE = 32  # points; smaller leaves take longer to build, and no less to search


class KdTree(VoxelMapAssociation):
    """The nearest point of a voxel map by scipy's KdTree, rebuilt once per inserted scan.

    The tree is built and searched on the CPU, even if the map is on a GPU.

    Source: Dellenbach et al. 2021, III-A "Local map and neighborhood", Kd-F2M.
    """

    def clear(self) -> None:
        """Forget every scan."""
        super().clear()
        self._tree: cKDTree | None = None

    def insert(self, points: Float[Tensor, "n 3"], T_world_lidar: Float[Tensor, "4 4"], frames: int) -> None:
        """Add a registered scan; the tree is rebuilt at the next search."""
        super().insert(points, T_world_lidar, frames)
        self._tree = None

    def nearest(self, points_world: Float[Tensor, "n 3"], bins: Int[Tensor, "n"], max_distance_m: float) -> Neighbours:
        """The exact nearest neighbour within `max_distance_m`."""
        if self._tree is None:
            # A sliding-midpoint tree is built four times faster than a balanced one and searched as fast.
            points = self.points.cpu().contiguous().numpy()
            self._tree = cKDTree(points, leafsize=_LEAF_SIZE, balanced_tree=False, compact_nodes=False)
        queries = points_world.cpu().numpy()
        workers = 1 if len(queries) < _MIN_PARALLEL_QUERIES else torch.get_num_threads()
        reach_m = max_distance_m + _SEARCH_MARGIN_M
        found = self._tree.query(queries, k=2, distance_upper_bound=reach_m, workers=workers)
        distances, index = np.asarray(found[0]), np.asarray(found[1])
        index = np.where(np.isfinite(distances[:, 0]), index[:, 0], -1)
        others = np.minimum(distances[:, 1], reach_m)
        return Neighbours(
            points_world,
            bins,
            torch.from_numpy(index).to(self._device),
            torch.from_numpy(others).to(points_world),
        )
