from dataclasses import dataclass, replace

import pytest
import torch

from lidarlearn.data.on_disk import SequenceOnDisk
from lidarlearn.data.scan_files import ScanFiles
from lidarlearn.data.sequence import Scan


@dataclass(frozen=True, eq=False, kw_only=True)
class Cropped(SequenceOnDisk):
    """A sequence of a user's reader, with a setting that is not a scalar."""

    box_m: tuple[float, float]

    def scan(self, index):
        return Scan(torch.zeros(1, 3))


@pytest.mark.parametrize("setting", [{"box_m": (0.0, 9.0)}, {"beam_correction_deg": 0.2}], ids=str)
def test_fingerprint_depends_on_settings_of_scans_only(setting, tmp_path):
    sequence = Cropped(
        name="drive", scans=ScanFiles(tmp_path, (), ()), T_world_lidar=None, timestamps=None, beam_correction_deg=0.0,
        box_m=(0.0, 5.0),
    )  # fmt: skip
    assert replace(sequence, **setting).fingerprint != sequence.fingerprint
    assert replace(sequence, name="another").fingerprint == sequence.fingerprint
    posed = replace(sequence, T_world_lidar=torch.eye(4, dtype=torch.float64)[None], timestamps=torch.zeros(1))
    assert posed.fingerprint == sequence.fingerprint
