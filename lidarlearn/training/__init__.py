"""Training PoseNet with Lightning: modules, validation as an odometry, checkpoints, what is shown meanwhile."""
