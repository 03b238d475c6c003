"""`python evaluate.py`: run odometries, or take the trajectories of other tools, and score them."""

import sys
import tempfile
from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf, open_dict
from torch import Tensor

import lidarlearn
from lidarlearn.commands import entry_point
from lidarlearn.commands.run_folder import git_revision, write_run_description
from lidarlearn.data.sequence import DataSet, Sequence
from lidarlearn.errors import UserError
from lidarlearn.evaluation.methods import BASELINES, Method, parse_method
from lidarlearn.evaluation.plots import figures, write_plots
from lidarlearn.evaluation.report import print_tables, write_report
from lidarlearn.evaluation.run import Export, RunProgress, read_export, run_odometry
from lidarlearn.evaluation.score import Score, score
from lidarlearn.evaluation.trajectories import find_trajectories, read_trajectory, to_lidar_frame
from lidarlearn.odometry.scan_by_scan import InitializationAlone, ScanByScan
from lidarlearn.training.checkpoints import load_checkpoint, sha256
from lidarlearn.training.parts import require_trusted

_WITH_NETWORK = ("posenet", "posenet+p_f2m", "cv+p_f2m")
_WITHOUT_NETWORK = ("cv+p_f2m", "cv+kd_f2m", "cv+vh_f2m")
_DATA_OF_CHECKPOINT = "checkpoint"  # the choice of data that stands for the checkpoint's own


def main() -> None:
    """Entry point of `evaluate.py` and `lidarlearn-evaluate`."""
    with tempfile.TemporaryDirectory() as folder:
        entry_point.run(_evaluate_as_chosen, "evaluate", lambda: _add_data_of_checkpoint(sys.argv, Path(folder)))


@dataclass(frozen=True)
class Evaluation:
    """What was evaluated.

    Args:
        sequences: by name.
        T_world_lidar: poses by method and sequence.
        scores: one per method and sequence.
    """

    sequences: Mapping[str, Sequence]
    T_world_lidar: Mapping[str, Mapping[str, Tensor]]
    scores: Series[Score]


def evaluate(config: DictConfig, data_name: str) -> Evaluation:
    """Run or read as configured, score, and write everything into the run folder.

    What is finished when an error comes up is reported before the error goes on.

    Args:
        config: composed from `configs/evaluate.yaml`.
        data_name: the config's choice of data.

    Raises:
        UserError: the data, the checkpoint, a trajectory or a setting is not as it should be.
    """
    _seed(config.seed)
    with open_dict(config):
        config.device = _device(config.device)
    run_folder = Path(config.run_dir)
    methods = _methods(config)
    data: DataSet = instantiate(config.data)
    data.prepare()
    sequences = {name: data.sequence(name) for name in data.test_sequences}
    if not sequences:
        raise UserError('data.test_sequences is empty\n  change: data.test_sequences=["..."]')
    write_run_description(run_folder, config)
    protocol = _protocol(config, data_name)
    poses: dict[str, dict[str, Tensor]] = {}
    scores: list[Score] = []
    results = _foreign(config, sequences) if config.trajectories else _own(config, methods, sequences, run_folder)
    try:
        for row, T_world_lidar in results:
            scores.append(row)
            poses.setdefault(row.method, {})[row.sequence] = T_world_lidar
    finally:
        if scores:
            _report(run_folder, protocol, Evaluation(sequences, poses, scores))
    return Evaluation(sequences, poses, scores)


def _own(
    config: DictConfig, methods: Series[Method], sequences: Mapping[str, Sequence], run_folder: Path
) -> Iterator[tuple[Score, Tensor]]:
    """Run every method on every sequence, and score what they export."""
    with RunProgress() as progress:
        for method in methods:
            for sequence in sequences.values():
                export = Export(run_folder / "trajectories" / str(method), sequence.name)
                task = progress.start(str(method), sequence)
                odometry = build_odometry(config, method)
                run_odometry(odometry, sequence, export, config.data.deskew, partial(progress.advance, task))
                T_world_lidar, summary = read_export(export, sequence)
                health = summary["health"]
                progress.done(task, str(method), sequence, summary["frames_per_second"], health["flagged"])
                yield (
                    score(str(method), T_world_lidar, sequence, summary["frames_per_second"], health),
                    T_world_lidar,
                )


def _foreign(config: DictConfig, sequences: Mapping[str, Sequence]) -> Iterator[tuple[Score, Tensor]]:
    """Score the trajectories of other tools."""
    found = find_trajectories(Path(config.trajectories), list(sequences))
    for method, files in found.items():
        for name, path in files.items():
            sequence = sequences[name]
            poses = read_trajectory(path, sequence.timestamps)
            T_world_lidar = to_lidar_frame(
                poses, config.trajectories_frame, sequence.reference_frame, sequence.T_reference_lidar
            )
            yield score(method, T_world_lidar, sequence), T_world_lidar


def build_odometry(config: DictConfig, method: Method) -> ScanByScan:
    """A fresh odometry for a method, from the groups `initialization`, `odometry` and `pipeline`, or `baseline`."""
    if method.initialization in BASELINES:
        return instantiate(config.baseline[method.initialization])
    initialization = instantiate(config.initialization[method.initialization])
    if method.backend is None:
        return InitializationAlone(initialization, config.device)
    return instantiate(config.pipeline)(initialization, instantiate(config.odometry[method.backend]))


def _evaluate_as_chosen(config: DictConfig) -> None:
    name = HydraConfig.get().runtime.choices["data"]
    if name == _DATA_OF_CHECKPOINT:
        name = load_checkpoint(Path(config.ckpt))["hyper_parameters"]["trained_on"]["data_name"]
    evaluate(config, name)


def _methods(config: DictConfig) -> list[Method]:
    names = config.methods
    if names is None:
        names = _WITH_NETWORK if config.ckpt else _WITHOUT_NETWORK
    methods = [parse_method(str(name)) for name in ([names] if isinstance(names, str) else names)]
    needing = [str(method) for method in methods if method.initialization == "posenet"]
    if needing and config.ckpt is None and not config.trajectories:
        raise UserError(f"{', '.join(needing)}: a trained network is needed\n  change: ckpt=RUN/checkpoints/best.ckpt")
    return methods


def _device(name: str) -> str:
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("device=cuda: torch finds no CUDA device\n  change: device=auto or device=cpu")
    if name not in ("cpu", "cuda"):
        raise UserError(f"device={name}: there is no such device\n  change: device=auto, cpu or cuda")
    return name


def _seed(seed: int) -> None:
    torch.manual_seed(seed)
    np.random.seed(seed)


def _protocol(config: DictConfig, data_name: str) -> dict[str, Any]:
    """Everything that two results must have in common to be comparable, and what they were made with."""
    data = config.data
    return {
        "data": data_name,
        "sequences": list(data.test_sequences),
        "max_frames": data.max_frames,
        "beam_correction_deg": data.beam_correction_deg,
        "deskew": data.deskew,
        "trajectory_frame": "the data set's reference frame (KITTI odometry: left camera)",
        "checkpoint": _checkpoint(config.ckpt),
        "lidarlearn": lidarlearn.__version__,
        "git": git_revision(),
        "torch": torch.__version__,
        "seed": config.seed,
        "device": config.device,
    }


def _checkpoint(path: str | None) -> dict[str, Any] | None:
    if path is None:
        return None
    trained_on = load_checkpoint(Path(path))["hyper_parameters"]["trained_on"]
    return {
        "path": path,
        "sha256": sha256(Path(path)),
        "trained_on": {
            "data": trained_on["data_name"],
            "train_sequences": trained_on["data"]["train_sequences"],
            "loss": trained_on["loss"],
            "git": trained_on["git"],
        },
    }


def _report(run_folder: Path, protocol: dict[str, Any], evaluation: Evaluation) -> None:
    """Files, plots, TensorBoard and the printed tables."""
    from torch.utils.tensorboard import SummaryWriter  # slow to import, and only needed at the end

    checkpoint = protocol["checkpoint"]
    trained_on = checkpoint["trained_on"]["train_sequences"] if checkpoint else ()
    write_report(run_folder, protocol, evaluation.scores, trained_on)
    write_plots(run_folder / "plots", figures(evaluation.sequences, evaluation.T_world_lidar, evaluation.scores))
    with SummaryWriter(str(run_folder)) as writer:
        for name, figure in figures(evaluation.sequences, evaluation.T_world_lidar, evaluation.scores):
            writer.add_figure(name, figure)
        writer.add_text("results", (run_folder / "results.md").read_text())
    print_tables(protocol["data"], evaluation.scores, trained_on)
    print(f"results: {run_folder / 'results.md'}  plots: {run_folder / 'plots'}")


def _add_data_of_checkpoint(arguments: list[str], folder: Path) -> None:
    """Let `ckpt=...` without `data=...` choose the data the checkpoint was trained on.

    Its config becomes one more option of the group `data`, so every override of a setting works on it as on others.
    """
    given = {override.split("=", 1)[0].lstrip("+"): override for override in arguments[1:] if "=" in override}
    if "ckpt" not in given or "data" in given:
        return
    try:
        path = OverridesParser.create().parse_override(given["ckpt"]).value()
    except OverrideParseException:
        return  # composing the configuration will say what is wrong
    if not isinstance(path, str):
        return
    data = load_checkpoint(Path(path))["hyper_parameters"]["trained_on"]["data"]
    require_trusted(data)
    (folder / "data").mkdir()
    OmegaConf.save(OmegaConf.create(data), folder / "data" / f"{_DATA_OF_CHECKPOINT}.yaml")
    arguments += [f"data={_DATA_OF_CHECKPOINT}", f"hydra.searchpath=[file://{folder}]"]
