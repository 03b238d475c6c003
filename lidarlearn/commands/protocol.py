"""The settings behind each trajectory, and the protocol that is stored with a table."""

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

import lidarlearn
from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.run_folder import git_revision
from lidarlearn.data.sequence import Sequence
from lidarlearn.errors import UserError
from lidarlearn.evaluation.methods import Method
from lidarlearn.training.checkpoints import load_checkpoint, sha256

_STEPS_PER_M = 2**13  # about 0.1 mm; a power of two, because decimals in files are rarely halfway between two steps


def describe_networks(config: DictConfig, methods: Iterable[Method]) -> dict[str, dict[str, Any]]:
    """Path, hash and training data of the checkpoint of each network that the methods use.

    Raises:
        UserError: checkpoints are not given or do not exist; the message lists all of them.
        CheckpointError: a file is no checkpoint.
    """
    used = dict.fromkeys(m.initialization for m in methods if m.initialization in config.networks)
    missing = [_remedy(name, config.networks[name]) for name in used if not Path(config.networks[name] or "").is_file()]
    if missing:
        raise UserError("\n".join(missing))
    return {name: _checkpoint(Path(config.networks[name])) for name in used}


def method_settings(config: DictConfig, method: Method, networks: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """All settings that the result of a method depends on, besides the scans.

    Args:
        config: composed from `configs/evaluate.yaml`.
        method: the method.
        networks: see `describe_networks`.
    """
    settings: dict[str, Any] = {"deskew": config.data.deskew, "seed": config.seed, "device": config.device}
    if method.initialization in config.baseline:
        parts = {"baseline": config.baseline[method.initialization]}
    else:
        own = "posenet" if method.initialization in networks else method.initialization
        parts = {"initialization": config.initialization[own]}
        if method.backend is not None:
            parts |= {"odometry": config.odometry[method.backend], "pipeline": config.pipeline}
    settings |= {name: OmegaConf.to_container(part, resolve=True) for name, part in parts.items()}
    if method.initialization in networks:  # the content of the file counts, not its path
        settings["initialization"].pop("network")
        settings["network"] = networks[method.initialization]["sha256"]
    return settings


def differing_settings(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """Which settings of an earlier run differ, in a few words."""
    names = [name for name in dict.fromkeys([*wanted, *found]) if found.get(name) != wanted.get(name)]
    return f"the run folder has it with other settings ({', '.join(names)})"


def evaluation_protocol(
    config: DictConfig, data_name: str, networks: Mapping[str, Mapping[str, Any]], sequences: Mapping[str, Sequence]
) -> dict[str, Any]:
    """Everything that must agree for two results to be comparable, and the versions and settings behind them."""
    data = config.data
    frame = ", ".join(dict.fromkeys(sequence.reference_frame for sequence in sequences.values()))
    trajectories = {"path": config.trajectories, "frame": config.trajectories_frame or frame}
    return {
        "data": data_name,
        "sequences": list(sequences),
        "scans": {name: sequence.fingerprint[:16] for name, sequence in sequences.items()},
        "ground_truth": {name: ground_truth_digest(sequence) for name, sequence in sequences.items()},
        "max_frames": data.max_frames,
        "beam_correction_deg": data.beam_correction_deg,
        "deskew": data.deskew,
        "trajectory_frame": frame,
        "trajectories": None if config.trajectories is None else trajectories,
        "checkpoint": networks.get("posenet"),
        "networks": {name: network for name, network in networks.items() if name != "posenet"},
        "lidarlearn": lidarlearn.__version__,
        "git": git_revision(),
        "torch": torch.__version__,
        "seed": config.seed,
        "device": config.device,
    }


def ground_truth_digest(sequence: Sequence) -> str | None:
    """Hash of the ground truth of a sequence; None if there is none.

    It ignores the last digits, in which poses computed from the same files differ between machines.
    """
    if sequence.T_world_lidar is None:
        return None
    poses = torch.cat([sequence.T_world_lidar, sequence.T_reference_lidar[None]])
    return hashlib.sha256((poses * _STEPS_PER_M).round().long().numpy().tobytes()).hexdigest()[:16]


def _remedy(network: str, path: str | None) -> str:
    """Message about a missing checkpoint of a network, and how to get it."""
    seen = f"networks.{network}: a trained network is needed" if path is None else f"networks.{network}: no file {path}"
    setting = "ckpt" if network == "posenet" and path is None else f"networks.{network}"
    remedy = f"{seen}\n  change: {setting}=RUN/checkpoints/best.ckpt"
    experiment = f"network/{Path(path or '').parent.parent.name}"  # trains into outputs/network/<name>/checkpoints
    if (config_directory() / "experiment" / f"{experiment}.yaml").is_file():
        remedy += f", or train it: python train.py experiment={experiment}"
    return remedy


def _checkpoint(path: Path) -> dict[str, Any]:
    trained_on = load_checkpoint(path)["hyper_parameters"]["trained_on"]
    return {
        "path": str(path),
        "sha256": sha256(path),
        "trained_on": {
            "data": trained_on["data_name"],
            # earlier versions stored them as configured: null, or numbers
            "train_sequences": trained_on.get("train_sequences", trained_on["data"]["train_sequences"]),
            "loss": trained_on["loss"],
            "git": trained_on["git"],
        },
    }
