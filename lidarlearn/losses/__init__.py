"""The losses of PoseNet: projective point-to-plane alignment, and the distance to ground truth."""
