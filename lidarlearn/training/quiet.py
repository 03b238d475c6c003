"""Which of Lightning's and torch's remarks are not for the user."""

import logging
import warnings

# Each with the reason why it says nothing to someone who trains.
_NOT_FOR_THE_USER = (
    r".*does not have many workers.*",  # maps are mapped into memory: workers hardly help, and cores may be few
    r".*is smaller than the logging interval.*",  # small data sets are legitimate; epoch values are logged anyway
    r".*Checkpoint directory .* exists and is not empty.*",  # resuming into the same run folder is legitimate
    r".*You're resuming from a checkpoint that ended before the epoch ended.*",  # told where true
    r".*LeafSpec.*deprecated.*",  # Lightning's own use of torch
    r".*Total length of `list` across ranks is zero.*",  # one may go without validation
    r".*It is recommended to use `self.log\('val/.*",  # every process has them from all: `PoseNetModule` gathers
    r".*all_gather is deprecated.*",  # Lightning's own use of torch
    r".*could not find the monitored key.*",  # likewise, or a first epoch that is not validated yet
    r".*Consider setting `persistent_workers=True`.*",  # they are, where there are workers
    r".*The dirpath has changed from.*",  # a run that resumes may have a new folder
    r".*TensorFloat32 tensor cores.*",  # scans need 32 bits, the network has trainer.precision
    r".*Detected call of `lr_scheduler.step\(\)` before `optimizer.step\(\)`.*",  # 16 bits skip overflowing first steps
)


def quiet() -> None:
    """Hide hardware banners, tips and warnings about legitimate choices; whatever else is said stays."""
    for name in ("lightning.pytorch", "lightning.fabric", "lightning.pytorch.utilities.rank_zero"):
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.getLogger("lightning.pytorch.profilers").setLevel(logging.INFO)  # who asks for a profile wants to read it
    for message in _NOT_FOR_THE_USER:
        warnings.filterwarnings("ignore", message=message)
