"""How far an estimated trajectory is from the truth: KITTI's segments, absolute and relative errors, failures."""
