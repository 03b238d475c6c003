"""`python evaluate.py`: run odometries, or read the trajectories of other tools, and score them."""

import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from lidarlearn.commands import entry_point
from lidarlearn.commands.checkpoint_options import OPTION, add_data, chosen_data
from lidarlearn.commands.device import resolve_device
from lidarlearn.commands.protocol import describe_networks, differing_settings, evaluation_protocol, method_settings
from lidarlearn.commands.run_folder import code_digest, held_run_folder, write_run_description
from lidarlearn.data.sequence import DataSet, Sequence
from lidarlearn.errors import UserError
from lidarlearn.evaluation.methods import Method, parse_method
from lidarlearn.evaluation.plots import figures
from lidarlearn.evaluation.report import print_tables, write_report
from lidarlearn.evaluation.run import Export, read_export, run_odometry
from lidarlearn.evaluation.score import Score, score
from lidarlearn.evaluation.submission import is_kitti_test_set, write_submission
from lidarlearn.evaluation.table_layout import TableLayout
from lidarlearn.evaluation.trajectory_files import find_trajectories, lidar_poses, read_trajectory
from lidarlearn.odometry.base import BaseOdometry
from lidarlearn.odometry.initialization_only import InitializationOnly
from lidarlearn.progress import progress

_WITH_NETWORK = ("posenet", "posenet+p_f2m", "cv+p_f2m")
_WITHOUT_NETWORK = ("cv+p_f2m", "cv+kd_f2m", "cv+vh_f2m")


def main() -> None:
    """Entry point of `evaluate.py` and `lidarlearn-evaluate`."""
    with tempfile.TemporaryDirectory() as folder:
        entry_point.run(_evaluate_locked, "evaluate", lambda: add_data(sys.argv, Path(folder)))


def evaluate(config: DictConfig, data_name: str) -> None:
    """Run methods or read trajectories, score them, and write everything into the run folder.

    After an error the finished sequences are reported before the error is raised again.

    Args:
        config: composed from `configs/evaluate.yaml`.
        data_name: the chosen option of the group `data`.

    Raises:
        UserError: the data, the checkpoint, a trajectory or a setting is invalid.
    """
    torch.manual_seed(config.seed)
    np.random.seed(config.seed)
    resolve_device(config)
    run_folder = Path(config.run_dir)
    methods = _methods(config)
    networks = describe_networks(config, methods)
    layout: TableLayout | None = instantiate(config.table, _convert_="all")
    data: DataSet = instantiate(config.data)
    data.prepare(data.test_sequences)
    sequences = data.sequences(data.test_sequences)
    if not sequences:
        raise UserError('data.test_sequences is empty\n  change: data.test_sequences=["..."]')
    write_run_description(run_folder, config)
    protocol = evaluation_protocol(config, data_name, networks, sequences)
    poses: dict[str, dict[str, Tensor]] = {}
    scores: list[Score] = []
    if config.trajectories:
        results = _score_trajectories(config, sequences)
    else:
        results = _run_methods(config, methods, networks, sequences, run_folder)
    try:
        for row, T_world_lidar in results:
            scores.append(row)
            poses.setdefault(row.method, {})[row.sequence] = T_world_lidar
    finally:
        if scores:
            _report(run_folder, protocol, sequences, poses, scores, layout)
    if is_kitti_test_set(sequences.values()):
        for method in methods:
            packed = write_submission(
                run_folder / f"submission_{method}.zip", run_folder / "trajectories" / str(method)
            )
            print(f"for KITTI's test server: {packed}")


def _run_methods(
    config: DictConfig,
    methods: list[Method],
    networks: Mapping[str, Mapping[str, Any]],
    sequences: Mapping[str, Sequence],
    run_folder: Path,
) -> Iterator[tuple[Score, Tensor]]:
    """Run every method on every sequence and score the exported trajectories; finished ones are reused."""
    data = OmegaConf.to_container(config.data, resolve=True)
    for method in methods:
        of_method = method_settings(config, method, networks)
        of_method["code"] = code_digest(of_method, data)
        for sequence in sequences.values():
            what = f"{method} on {sequence.name}"
            export = Export(run_folder / "trajectories" / str(method), sequence.name)
            settings = {"scans": sequence.fingerprint, **of_method}
            found = export.settings()
            if found != settings:
                if found is not None:
                    print(f"{what}: run again, {differing_settings(found, settings)}", flush=True)
                odometry = build_odometry(config, method)
                with progress(what, len(sequence)) as advance:
                    run_odometry(odometry, sequence, export, config.data.deskew, advance, settings)
            T_world_lidar, summary = read_export(export, sequence)
            speed, health = summary["frames_per_second"], summary["health"]
            print(
                f"{method!s:<16} {sequence.name:<12} {len(sequence):>5} scans  {speed:6.1f} scans/s  "
                f"{health['flagged']} flagged{'  (found in the run folder)' if found == settings else ''}",
                flush=True,
            )
            yield score(str(method), T_world_lidar, sequence, speed, health), T_world_lidar


def _score_trajectories(config: DictConfig, sequences: Mapping[str, Sequence]) -> Iterator[tuple[Score, Tensor]]:
    """Score the trajectories of other tools."""
    found = find_trajectories(Path(config.trajectories), list(sequences))
    for method, files in found.items():
        for name, path in files.items():
            sequence = sequences[name]
            T_world = read_trajectory(path, sequence.timestamps)
            T_world_lidar = lidar_poses(T_world, config.trajectories_frame, sequence, path)
            yield score(method, T_world_lidar, sequence), T_world_lidar


def configured_method(config: DictConfig, name: str) -> Method:
    """Parse the name of a method with the parts of the configuration, see `parse_method`."""
    initializations = dict.fromkeys([*config.initialization, *config.networks])
    return parse_method(name, initializations, list(config.odometry), list(config.baseline))


def build_odometry(config: DictConfig, method: Method) -> BaseOdometry:
    """A new odometry for a method, from the groups `initialization`, `odometry` and `pipeline`, or `baseline`.

    A network is built from `initialization.posenet` with the checkpoint of that name in `networks`.
    """
    if method.initialization in config.baseline:
        return instantiate(config.baseline[method.initialization])
    if method.initialization in config.networks:
        network = {"path": config.networks[method.initialization]}
        initialization = instantiate(config.initialization.posenet, network=network)
    else:
        initialization = instantiate(config.initialization[method.initialization])
    if method.backend is None:
        return InitializationOnly(initialization, config.device)
    return instantiate(config.pipeline)(initialization, instantiate(config.odometry[method.backend]))


def _evaluate_locked(config: DictConfig) -> None:
    _require_use_of_checkpoint(config)
    with held_run_folder(Path(config.run_dir)):
        evaluate(config, chosen_data(config))


def _require_use_of_checkpoint(config: DictConfig) -> None:
    """Raise a `UserError` if `ckpt=...` provides neither a network nor the data."""
    used = {config.networks.get(method.initialization) for method in _methods(config)}
    if config.ckpt is not None and config.ckpt not in used and HydraConfig.get().runtime.choices["data"] != OPTION:
        raise UserError(
            f"ckpt={config.ckpt}: no method uses this network\n"
            f"  change: networks.posenet={config.ckpt} where an experiment names another, or methods=[posenet,...], "
            "or leave ckpt out"
        )


def _methods(config: DictConfig) -> list[Method]:
    """The methods to run; none if trajectories are scored instead."""
    names = config.methods
    if config.trajectories is not None:
        if names is not None:
            raise UserError(
                f"trajectories={config.trajectories} are scored instead of running methods={names}\n"
                "  change: methods=null, or run the methods without trajectories=... and compare both with "
                "python -m lidarlearn.evaluation compare RUN RUN"
            )
        return []
    if names is None:
        names = _WITH_NETWORK if config.ckpt else _WITHOUT_NETWORK
    names = [str(name) for name in ([names] if isinstance(names, str) else names)]
    return [configured_method(config, name) for name in names]


def _report(
    run_folder: Path,
    protocol: Mapping[str, Any],
    sequences: Mapping[str, Sequence],
    poses: Mapping[str, Mapping[str, Tensor]],
    scores: list[Score],
    layout: TableLayout | None,
) -> None:
    """Files, plots, TensorBoard and the printed tables."""
    from torch.utils.tensorboard import SummaryWriter  # slow to import, only needed at the end

    tables = write_report(run_folder, protocol, scores, layout)
    plots = run_folder / "plots"
    plots.mkdir(exist_ok=True)
    with SummaryWriter(str(run_folder)) as writer:
        for name, figure in figures(sequences, poses, scores, {} if layout is None else layout.columns):
            figure.savefig(plots / f"{name}.png")
            writer.add_figure(name, figure)
        writer.add_text("results", (run_folder / "results.md").read_text(encoding="utf-8"))
    print_tables(tables)
    print(f"results: {run_folder / 'results.md'}  plots: {plots}")
