"""What the tests on a folder of scans share, see the fixture `scans`."""

FRAMES = 6
SENSOR = [
    "data.projection.height=16", "data.projection.width=96", "data.projection.fov_up_deg=15.0",
    "data.projection.fov_down_deg=-20.0",
]  # fmt: skip
