"""The best checkpoint of a whole training, also of one that was resumed."""

import shutil
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from lidarlearn.training.checkpoints import load_checkpoint


class BestCheckpoint(ModelCheckpoint):
    """Keeps the epoch with the smallest validation error as `best.ckpt`.

    A training that goes on in another folder begins with the best checkpoint beside the one it was resumed from, and
    its error; where it validates on other data, errors do not compare, and the best is chosen anew.

    Args:
        dirpath: folder of the checkpoint.
        monitor: what is smallest in the best epoch.
    """

    def __init__(self, dirpath: str, monitor: str = "val/error") -> None:
        super().__init__(dirpath, "best", monitor=monitor, save_on_train_epoch_end=True, enable_version_counter=False)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Leave out what Lightning would take over: the file may have been moved, or be of a later epoch."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take over the best checkpoint so far."""
        super().on_train_start(trainer, pl_module)
        if not trainer.ckpt_path:
            return
        found = Path(trainer.ckpt_path).with_name("best.ckpt")
        if not found.is_file():
            return
        best = load_checkpoint(found)
        state = best.get("callbacks", {}).get(self.state_key)
        is_earlier = best["epoch"] < trainer.current_epoch
        same_data = best["hyper_parameters"]["trained_on"]["data"] == pl_module.hparams["trained_on"]["data"]
        if state is None or not is_earlier or not same_data:
            return
        here = Path(str(self.dirpath)) / found.name
        if trainer.is_global_zero and not (here.exists() and here.samefile(found)):
            here.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(found, here)
        self.best_model_path = self.kth_best_model_path = str(here)
        self.best_model_score = self.kth_value = state["best_model_score"]
        self.best_k_models = {str(here): state["best_model_score"]}
