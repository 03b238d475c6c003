"""Command lines on the folder of the fixture `scans`."""

from pathlib import Path

FRAMES = 6
SENSOR = [
    "data.projection.height=16", "data.projection.width=96", "data.projection.fov_up_deg=15.0",
    "data.projection.fov_down_deg=-20.0",
]  # fmt: skip


def on_scans(scans: Path) -> list[str]:
    """The overrides that choose these scans."""
    return ["data=folder", f"data.root={scans}", *SENSOR]
