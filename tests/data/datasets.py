"""Data sets with the settings of their configs, and findings of their checks."""

from hydra.utils import instantiate

from lidarlearn.data.sequence import DataSet, LayoutReport
from tests.commands.configs import composed

SPLITS = ("train_sequences", "val_sequences", "test_sequences")


def data_set(name: str, root: object = "nowhere", sequence: str | None = None, **settings: object) -> DataSet:
    """What `data=name data.root=ROOT data.SETTING=...` selects.

    Args:
        name: option of the group `data`.
        root: folder of the data set.
        sequence: the only sequence of all three splits; None leaves those of the config.
        settings: others than those of the config.
    """
    splits = {} if sequence is None else dict.fromkeys(SPLITS, sequence)
    return instantiate(composed("data", f"data={name}").data, root=str(root), **(splits | settings))


def findings(report: LayoutReport, level: str) -> str:
    """Subject and detail of all findings of a level, in one line."""
    return " | ".join(f"{f.what} {f.detail}" for f in report.findings if f.level == level)
