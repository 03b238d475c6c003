"""Training PoseNet with Lightning: modules, validation as an odometry, checkpoints, progress."""
