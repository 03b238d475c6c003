"""Hides messages of Lightning and torch that are of no use to the user."""

import logging
import warnings

_HIDDEN_WARNINGS = (
    r".*does not have many workers.*",  # scans are memory-mapped: workers hardly help, and cores may be few
    r".*is smaller than the logging interval.*",  # small data sets are legitimate; epoch values are logged anyway
    r".*Checkpoint directory .* exists and is not empty.*",  # resuming into the same run folder is legitimate
    r".*You're resuming from a checkpoint that ended before the epoch ended.*",  # `require_resumable` warns if it is so
    r".*LeafSpec.*deprecated.*",  # in Lightning's own code
    r".*Total length of `list` across ranks is zero.*",  # training without validation is legitimate
    r".*It is recommended to use `self.log\('val/.*",  # `PoseNetModule` has gathered the values of all processes
    r".*all_gather is deprecated.*",  # in Lightning's own code
    r".*could not find the monitored key.*",  # there is no validation, or none in the first epoch
    r".*Consider setting `persistent_workers=True`.*",  # the datamodule does so where it can
    r".*The dirpath has changed from.*",  # resuming into a new run folder is legitimate
    r".*TensorFloat32 tensor cores.*",  # scans need 32 bits; the network has trainer.precision
    r".*Detected call of `lr_scheduler.step\(\)` before `optimizer.step\(\)`.*",  # fp16 skips first steps that overflow
)


def quiet() -> None:
    """Hide hardware banners, tips and warnings about legitimate choices; show all other messages."""
    for name in ("lightning.pytorch", "lightning.fabric", "lightning.pytorch.utilities.rank_zero"):
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.getLogger("lightning.pytorch.profilers").setLevel(logging.INFO)  # profiles are only made on request
    for message in _HIDDEN_WARNINGS:
        warnings.filterwarnings("ignore", message=message)
