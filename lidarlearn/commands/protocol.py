"""What a result was made with: the settings behind each trajectory, and the protocol that its table carries."""

from collections.abc import Mapping
from collections.abc import Sequence as Series
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

import lidarlearn
from lidarlearn.commands.run_folder import git_revision
from lidarlearn.data.sequence import Sequence
from lidarlearn.evaluation.methods import Method
from lidarlearn.training.checkpoints import load_checkpoint, sha256


def method_settings(config: DictConfig, method: Method) -> dict[str, Any]:
    """All of the configuration that a method's result depends on, beside the scans."""
    settings: dict[str, Any] = {"deskew": config.data.deskew, "seed": config.seed, "device": config.device}
    if method.initialization in config.baseline:
        parts = {"baseline": config.baseline[method.initialization]}
    else:
        own = "posenet" if method.initialization in config.networks else method.initialization
        parts = {"initialization": config.initialization[own]}
        if method.backend is not None:
            parts |= {"odometry": config.odometry[method.backend], "pipeline": config.pipeline}
    settings |= {name: OmegaConf.to_container(part, resolve=True) for name, part in parts.items()}
    if method.initialization in config.networks:  # what counts is what the file holds, not where it lies
        settings["initialization"].pop("network")
        settings["network"] = sha256(Path(config.networks[method.initialization]))
    return settings


def differing_settings(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """What sets the settings of an earlier run apart, in a few words."""
    names = [name for name in dict.fromkeys([*wanted, *found]) if found.get(name) != wanted.get(name)]
    return f"the run folder has it with other settings ({', '.join(names)})"


def evaluation_protocol(
    config: DictConfig, data_name: str, methods: Series[Method], sequences: Mapping[str, Sequence]
) -> dict[str, Any]:
    """Everything that two results must have in common to be comparable, and what they were made with."""
    data = config.data
    used = dict.fromkeys(m.initialization for m in methods if m.initialization in config.networks)
    networks = {} if config.trajectories else {name: _checkpoint(config.networks[name]) for name in used}
    return {
        "data": data_name,
        "sequences": list(sequences),
        "scans": {name: sequence.fingerprint[:16] for name, sequence in sequences.items()},
        "max_frames": data.max_frames,
        "beam_correction_deg": data.beam_correction_deg,
        "deskew": data.deskew,
        "trajectory_frame": "the data set's reference frame (KITTI odometry: left camera)",
        "checkpoint": networks.pop("posenet", None),
        "networks": networks,
        "lidarlearn": lidarlearn.__version__,
        "git": git_revision(),
        "torch": torch.__version__,
        "seed": config.seed,
        "device": config.device,
    }


def _checkpoint(path: str) -> dict[str, Any]:
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
