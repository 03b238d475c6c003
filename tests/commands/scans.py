"""Command lines and evaluations on the folder of the fixture `scans`."""

from pathlib import Path

from omegaconf import DictConfig

from lidarlearn.commands.evaluate import evaluate
from tests.commands.configs import composed

FRAMES = 6
SENSOR = [
    "data.projection.height=16", "data.projection.width=96", "data.projection.fov_up_deg=15.0",
    "data.projection.fov_down_deg=-20.0",
]  # fmt: skip


def on_scans(scans: Path) -> list[str]:
    """The overrides that choose these scans."""
    return ["data=folder", f"data.root={scans}", *SENSOR]


def configured(program: str, scans: Path, run_dir: Path, *settings: str) -> DictConfig:
    """The config of a program on these scans; settings are merged into a config that is composed once."""
    config = composed(program, "device=cpu", *on_scans(scans))
    config.merge_with_dotlist([f"run_dir={run_dir}", *settings])
    return config


def evaluate_scans(scans: Path, run_dir: Path, *settings: str) -> None:
    """Evaluate as `evaluate.py SETTINGS` does."""
    evaluate(configured("evaluate", scans, run_dir, *settings), "folder")
