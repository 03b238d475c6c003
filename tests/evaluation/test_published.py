import pytest

from lidarlearn.evaluation.published import KITTI, KITTI_FRAMES, published_beside, whole_kitti_sequences
from lidarlearn.evaluation.score import Score


def rows(**frames):
    return [Score("m", name.removeprefix("s"), n) for name, n in frames.items()]


@pytest.mark.parametrize(
    ("method", "mean"),
    [
        ("IMLS-SLAM", 0.52),
        ("LOAM", 0.84),
        ("SuMa", 0.73),
        ("CT-ICP", 0.50),
        ("KISS-ICP", 0.496),
        ("KISS-ICP 1.3.0, re-run", 0.525),
        ("KISS-ICP, no beam correction", 1.05),
        ("GenZ-ICP, re-run", 0.519),
        ("MULLS-LO", 0.49),
        ("CV + Kd-F2M, Dellenbach 2021", 0.502),
        ("CV + P-F2M, Dellenbach 2021", 0.678),
    ],
)
def test_published_rows_have_their_published_mean(method, mean):
    """A typing error in a row changes its mean."""
    (row,) = [row for row in KITTI if row.method == method]
    digits = 3 if round(mean, 2) != mean else 2
    assert row.sequence_mean_percent(list(KITTI_FRAMES)) == pytest.approx(mean, abs=0.6 * 10**-digits)


def test_sequence_mean_needs_all_requested_sequences():
    (delora,) = [row for row in KITTI if row.method.startswith("DeLORA")]
    assert delora.sequence_mean_percent(["09", "10"]) == pytest.approx((6.05 + 6.44) / 2)
    assert delora.sequence_mean_percent(["08", "09"]) is None
    assert delora.sequence_mean_percent([]) is None


def test_whole_kitti_sequences_excludes_partial_ones():
    scores = rows(s04=51, s09=1591, s10=1201, s11=921)
    assert whole_kitti_sequences("kitti_00-08", scores) == ["09", "10"]
    assert whole_kitti_sequences("kitti_raw", scores) == []
    assert whole_kitti_sequences("simulated_urban", scores) == []


def test_published_beside_omits_rows_without_these_sequences():
    on_09 = {row.method for row in published_beside(["09"])}
    on_00 = {row.method for row in published_beside(["00"])}
    assert on_09 - on_00 == {"DeLORA 00-08, unsupervised", "RSLO 00-06, unsupervised"}
    assert published_beside(whole_kitti_sequences("kitti_00-08", rows(s04=51))) == []
