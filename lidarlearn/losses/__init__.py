"""What PoseNet is trained to minimize: projective point-to-plane losses, and the distance to ground truth."""
