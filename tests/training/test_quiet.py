"""Which of Lightning's messages are hidden."""

import logging

from lightning.pytorch.profilers import SimpleProfiler

from lidarlearn.training.quiet import quiet


def test_quiet_hides_banner_but_not_profile(monkeypatch, caplog):
    quiet()
    monkeypatch.setattr(logging.getLogger("lightning.pytorch"), "propagate", True)
    logging.getLogger("lightning.pytorch.trainer").info("GPU available: False")
    SimpleProfiler().describe()
    (record,) = caplog.records
    assert "Profiler Report" in record.getMessage()
