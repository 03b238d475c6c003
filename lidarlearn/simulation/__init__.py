"""Simulated drives: procedural worlds, smooth trajectories, spinning LiDARs and ray casting."""
