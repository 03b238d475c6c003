"""Train PoseNet: `python train.py [data=...] [loss=...] [KEY=VALUE ...]`; see README.md and configs/train.yaml."""

from lidarlearn.commands.train import main

if __name__ == "__main__":
    main()
