"""Lightning's remarks: which are hidden, and which are not."""

import logging

from lightning.pytorch.profilers import SimpleProfiler

from lidarlearn.training.quiet import quiet


def test_a_profile_is_printed_and_a_banner_is_not(monkeypatch, caplog):
    quiet()
    monkeypatch.setattr(logging.getLogger("lightning.pytorch"), "propagate", True)
    logging.getLogger("lightning.pytorch.trainer").info("GPU available: False")
    SimpleProfiler().describe()
    (record,) = caplog.records
    assert "Profiler Report" in record.getMessage()
