"""Rigid motions, spherical projection, normals and voxels: pure, batched functions on tensors."""
