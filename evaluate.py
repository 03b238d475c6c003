"""Evaluate odometries: `python evaluate.py [ckpt=...] [methods=[...]] [data=...]`; see README.md, configs/evaluate.yaml."""

from lidarlearn.commands.evaluate import main

if __name__ == "__main__":
    main()
