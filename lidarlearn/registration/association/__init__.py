"""Neighbour associations: projective, KdTree and voxel hash, each a searchable map of the last registered scans."""

from lidarlearn.registration.association.base import Association, Correspondences
from lidarlearn.registration.association.kdtree import KdTree
from lidarlearn.registration.association.projective import Projective
from lidarlearn.registration.association.voxel_hash import VoxelHash

__all__ = ["Association", "Correspondences", "KdTree", "Projective", "VoxelHash"]
