"""Published average translation errors on KITTI, to be shown beside our own.

The values have exactly the digits of their sources, for sequences 00 to 10 in order ("-": not published), and hold for
whole sequences only. Publications state one of two averages: the mean over sequences is computed from the row; the
mean over segments cannot be, and is given if published. Numbers after a network's name are the sequences on which it
was trained.

Sources: each method's own paper; for LOAM, SuMa and DeepLO, later papers that quote them. "Dellenbach 2021" is Table I
of "What's in My LiDAR Odometry Toolbox?"; "re-run" means with the released code and its defaults.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from lidarlearn.evaluation.score import Score

# Number of scans in each sequence of the KITTI odometry benchmark with public ground truth.
KITTI_FRAMES = {
    "00": 4541,
    "01": 1101,
    "02": 4661,
    "03": 801,
    "04": 271,
    "05": 2761,
    "06": 1101,
    "07": 1101,
    "08": 4071,
    "09": 1591,
    "10": 1201,
}


@dataclass(frozen=True)
class Published:
    """One row of a published table.

    Args:
        method: name of the method, and what distinguishes the row.
        errors_percent: average translation error by sequence, as printed.
        segment_mean_percent: mean over the segments of all eleven sequences, as printed; empty if not published.
    """

    method: str
    errors_percent: dict[str, str]
    segment_mean_percent: str = ""

    def sequence_mean_percent(self, sequences: list[str]) -> float | None:
        """Mean over the given sequences; None unless every one of them is published."""
        if not sequences or any(name not in self.errors_percent for name in sequences):
            return None
        return sum(float(self.errors_percent[name]) for name in sequences) / len(sequences)


def _row(method: str, errors_percent: str, segment_mean_percent: str = "") -> Published:
    by_sequence = zip(KITTI_FRAMES, errors_percent.split(), strict=True)
    return Published(method, {name: text for name, text in by_sequence if text != "-"}, segment_mean_percent)


KITTI = (
    _row("IMLS-SLAM", "0.50 0.82 0.53 0.68 0.33 0.32 0.33 0.33 0.80 0.55 0.53", "0.553"),
    _row("LOAM", "0.78 1.43 0.92 0.86 0.71 0.57 0.65 0.63 1.12 0.77 0.79"),
    _row("SuMa", "0.73 1.71 1.06 0.66 0.38 0.50 0.42 0.39 1.02 0.48 0.71"),
    _row("CT-ICP", "0.49 0.76 0.52 0.72 0.39 0.25 0.27 0.31 0.81 0.49 0.48", "0.531"),
    _row("KISS-ICP", "0.520 0.630 0.514 0.658 0.358 0.308 0.260 0.328 0.821 0.504 0.560", "0.543"),
    _row("KISS-ICP 1.3.0, re-run", "0.528 0.786 0.537 0.677 0.385 0.342 0.281 0.375 0.820 0.534 0.512", "0.564"),
    _row("KISS-ICP, no beam correction", "0.906 2.12 1.23 1.07 0.93 0.78 0.64 0.50 1.11 0.90 1.40", "1.061"),
    _row("GenZ-ICP, re-run", "0.509 0.917 0.507 0.721 0.396 0.277 0.281 0.317 0.830 0.500 0.458", "0.548"),
    _row("MULLS-LO", "0.51 0.62 0.55 0.61 0.35 0.28 0.24 0.29 0.80 0.49 0.61", "0.539"),
    _row("EI + Kd-F2M, Dellenbach 2021", "0.53 0.79 0.52 0.69 0.45 0.34 0.31 0.36 0.79 0.54 0.51"),
    _row("CV + Kd-F2M, Dellenbach 2021", "0.51 0.79 0.51 0.64 0.36 0.29 0.29 0.32 0.78 0.46 0.57", "0.533"),
    _row("EI + P-F2M, Dellenbach 2021", "0.57 0.67 0.62 0.83 0.51 0.37 0.36 0.32 0.93 0.60 1.01"),
    _row("CV + P-F2M, Dellenbach 2021", "0.57 0.71 0.62 0.82 1.12 0.37 0.37 0.33 0.93 0.61 1.01", "0.643"),
    _row("PoseNet 00-08 + P-F2M, Dellenbach 2021", "0.601 0.67 0.68 0.85 0.56 0.41 0.39 0.34 0.96 0.69 1.07"),
    _row("PoseNet 00-08 + Kd-F2M, Dellenbach 2021", "0.55 0.85 0.58 0.74 0.44 0.34 0.36 0.33 0.88 0.61 0.83"),
    _row("PoseNet 00-08, ICP loss, Dellenbach 2021", "1.33 7.11 1.81 3.09 0.93 1.38 1.43 0.84 2.27 6.31 8.99"),
    _row("PoseNet 00-08, weighted, Dellenbach 2021", "1.36 1.88 1.46 2.33 0.969 1.26 1.05 1.07 2.05 6.79 7.6"),
    _row("LO-Net 00-06, supervised", "1.47 1.36 1.52 1.03 0.51 1.04 0.71 1.70 2.12 1.37 1.80"),
    _row("LO-Net 00-06 + mapping", "0.78 1.42 1.01 0.73 0.56 0.62 0.55 0.56 1.08 0.77 0.92"),
    _row("PWCLO-Net 00-06, supervised", "0.78 0.67 0.86 0.76 0.37 0.45 0.27 0.60 1.26 0.79 1.69"),
    _row("EfficientLO-Net 00-06, supervised", "0.83 0.55 0.71 0.49 0.22 0.34 0.36 0.46 1.14 0.78 0.80"),
    _row("RSLO 00-06, unsupervised", "- - - - - - - 2.37 2.14 2.61 2.33"),
    _row("DeepLO 00-08, unsupervised", "1.90 37.83 2.05 2.85 1.54 1.72 0.84 0.70 1.81 6.55 7.74"),
    _row("DeLORA 00-08, unsupervised", "- - - - - - - - - 6.05 6.44"),
)


def whole_kitti_sequences(data: str, scores: Iterable[Score]) -> list[str]:
    """The scored sequences that are whole sequences of the KITTI odometry benchmark, in order of appearance.

    Args:
        data: name of the data group, e.g. "kitti_00-08".
        scores: scores of any methods.
    """
    if not data.startswith("kitti_") or data == "kitti_raw":
        return []
    whole = (row.sequence for row in scores if KITTI_FRAMES.get(row.sequence) == row.frames)
    return list(dict.fromkeys(whole))


def published_beside(sequences: Collection[str]) -> list[Published]:
    """Published rows with a value for at least one of these whole sequences of KITTI."""
    return [row for row in KITTI if not row.errors_percent.keys().isdisjoint(sequences)]
