"""Evaluate odometries: `python evaluate.py [ckpt=...] [methods=[...]] [KEY=VALUE ...]`; see configs/evaluate.yaml."""

from lidarlearn.commands.evaluate import main

if __name__ == "__main__":
    main()
