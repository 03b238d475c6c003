"""Progress lines in output that is no terminal."""

from lidarlearn import progress as module
from lidarlearn.progress import progress, tracked


def test_progress_prints_first_line_and_then_at_intervals(capsys, monkeypatch):
    clock = iter(range(0, 1000, 9))
    monkeypatch.setattr(module.time, "monotonic", lambda: float(next(clock)))
    with progress("simulating 2 drives", 4400) as advance:
        assert capsys.readouterr().out == "simulating 2 drives: 4,400 scans\n"
        for _ in range(12):
            advance()
    printed = capsys.readouterr().out.splitlines()
    assert printed == [f"simulating 2 drives: {done} of 4,400 scans" for done in (4, 8, 12)]


def test_tracked_yields_items_unchanged(capsys):
    assert list(tracked([3, 1, 2], "reading", 3)) == [3, 1, 2]
    assert capsys.readouterr().out == "reading: 3 scans\n"
