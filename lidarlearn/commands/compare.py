"""Results side by side: `python -m lidarlearn.evaluation compare`, and the jobs of a multirun of `evaluate.py`."""

from pathlib import Path
from typing import Any

from filelock import FileLock
from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from lidarlearn.evaluation.compare import comparable_groups, comparison, read_run
from lidarlearn.evaluation.report import print_tables, write_results


def compare(runs: list[Path], output: Path | None = None) -> None:
    """Print the results of several runs side by side, and optionally write them.

    Args:
        runs: run folders of evaluations.
        output: folder for `results.json` and `results.md`; None only prints.

    Raises:
        UserError: a folder has no results.
    """
    content, tables, closing = comparison(comparable_groups([read_run(run) for run in runs]))
    print_tables(tables)
    print(closing.replace("### ", ""))
    if output is not None:
        write_results(output, content, tables, closing)
        print(f"results: {output / 'results.md'}")


class GatheredResults(Callback):
    """Keeps one table of all finished jobs in the folder of a multirun, and prints it at the end."""

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **_: Any) -> None:
        """Update the table after each job, in whichever process it ran."""
        if config.hydra.mode != RunMode.MULTIRUN:
            return
        folder = Path(config.hydra.sweep.dir)
        with FileLock(folder / "gather.lock"):
            runs = _finished(folder)
            if runs:
                write_results(folder, *comparison(comparable_groups([read_run(run) for run in runs])))

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Print the table."""
        folder = Path(config.hydra.sweep.dir)
        runs = _finished(folder)
        if not runs:
            return  # every job has reported its error
        compare(runs)
        print(f"results: {folder / 'results.md'}")


def _finished(folder: Path) -> list[Path]:
    """Folders of the jobs with results, in the order of their numbers."""
    found = [path.parent for path in folder.glob("*/results.json") if path.parent.name.isdigit()]
    return sorted(found, key=lambda path: int(path.name))
