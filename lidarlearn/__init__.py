"""Train, evaluate and compare LiDAR odometries: classical, learned and hybrid."""

__version__ = "0.1.0"
