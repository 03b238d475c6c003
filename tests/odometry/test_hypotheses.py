import torch

from lidarlearn.geometry import se3
from lidarlearn.odometry.hypotheses import start_motions, surprise_motions

FORWARD = se3.exp(torch.tensor([1.4, 0, 0, 0, 0, 0.05], dtype=torch.float64))
GUESS = se3.exp(torch.tensor([1.1, 0.2, 0, 0, 0, 0.02], dtype=torch.float64))


def contains(motions: torch.Tensor, wanted: torch.Tensor) -> bool:
    return bool(torch.isclose(motions, wanted).all(dim=(-1, -2)).any())


def test_start_motions_cover_standing_driving_and_turning():
    motions = start_motions(se3.identity())
    assert contains(motions, se3.identity())
    xi = se3.log(motions)
    assert xi[:, 0].max() >= 3.0 and xi[:, 0].min() <= -3.0  # 108 km/h at 10 Hz, whichever way the sensor looks
    assert xi[:, 5].max().rad2deg() >= 20 and xi[:, 5].min().rad2deg() <= -20
    forward = xi[xi[:, 5] == 0, 0].sort().values
    assert forward.diff().max() <= 1.0  # no speed is farther from a hypothesis than ICP pulls in


def test_start_motions_include_guess_once():
    assert contains(start_motions(GUESS), GUESS)
    assert len(start_motions(GUESS)) == len(start_motions(se3.identity())) + 1


def test_surprise_motions_cover_lost_and_repeated_scans():
    motions = surprise_motions(GUESS, FORWARD)
    for wanted in (GUESS, FORWARD, FORWARD @ FORWARD, se3.identity()):
        assert contains(motions, wanted)
    turns = se3.log(se3.inverse(FORWARD) @ motions)[:, 5].rad2deg()
    assert turns.max() >= 20 and turns.min() <= -20


def test_hypotheses_are_rigid_motions():
    for motions in (start_motions(GUESS), surprise_motions(GUESS, FORWARD)):
        assert motions.dtype == torch.float64
        torch.testing.assert_close(se3.orthonormalize(motions), motions)
