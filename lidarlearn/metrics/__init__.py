"""Errors of estimated trajectories: KITTI's segments, absolute and relative pose errors, failures."""
