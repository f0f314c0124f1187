"""Checkpoints while a training runs."""

import signal
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_causalgdp.checkpoints.checkpoint import begin_training, check_folder, save_checkpoint

ON_DIVERGENCE = ("raise", "restore")
TERMINATED = 143
"""Exit status of a process that ended because it was asked to, by SIGTERM."""


class TrainingCheckpointCallback(BaseCallback):
    """
    Write a checkpoint every so many steps and at the end, from which
    :meth:`CausalGDP.resume <sb3_causalgdp.CausalGDP.resume>` goes on bit for bit, whatever ended the process. It works with
    any of SB3's off-policy algorithms, see :func:`~sb3_causalgdp.checkpoints.resume`.

    Checkpoints are written between two rollouts (``train_freq``), where nothing is under way. On SIGTERM the training goes on
    to that point, writes one and exits with status 143.

    :param folder: Of the checkpoints; a folder for each training
    :param every: Environment steps from one checkpoint to the next, in ``pretrain()`` gradient steps
    :param keep: How many of the newest checkpoints to keep, None for all; transitions are shared by all
    :param at_end: Whether to write one at the end of the training, too, so that more steps can follow
    :param on_divergence: What ``CausalGDP.learn()`` does when the training diverges: ``raise`` the error, or ``restore`` the
        newest checkpoint and go on with other random numbers, three times at most
    :param handle_sigterm: Whether to write a checkpoint on SIGTERM
    :param verbose: Verbosity level: 1 prints each checkpoint
    :raises ValueError: If ``every`` or ``keep`` is below 1, and when the training starts, if the folder is another training's
    """

    model: Any  # an OffPolicyAlgorithm
    during_pretraining = True
    counts_nothing = True

    def __init__(
        self,
        folder: str | Path,
        every: int = 10_000,
        keep: int | None = 2,
        at_end: bool = True,
        on_divergence: str = "raise",
        handle_sigterm: bool = True,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        for name, value in {"every": every, "keep": 1 if keep is None else keep}.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value!r}")
        if on_divergence not in ON_DIVERGENCE:
            raise ValueError(f"on_divergence must be one of {list(ON_DIVERGENCE)}, got {on_divergence!r}")
        self.folder = Path(folder)
        self.every = every
        self.keep = keep
        self.at_end = at_end
        self.on_divergence = on_divergence
        self.handle_sigterm = handle_sigterm
        self._handler_before: Any = None
        self._was_asked_to_stop = False
        self._saved_at: int | None = None

    def _on_training_start(self) -> None:
        begin_training(self.model, self._top)
        check_folder(self.model, self.folder)
        self._saved_at = self.num_timesteps
        self._restore_handler()
        if self.handle_sigterm and threading.current_thread() is threading.main_thread():
            self._handler_before = signal.signal(signal.SIGTERM, self._ask_to_stop)

    def _ask_to_stop(self, number: int, frame: FrameType | None) -> None:
        if self._was_asked_to_stop:
            # Asked twice, or of a training that an error ended
            sys.exit(TERMINATED)
        self._was_asked_to_stop = True

    def _on_rollout_start(self) -> None:
        self._save_if_due()

    def _on_step(self) -> bool:
        if getattr(self.model, "is_pretraining", False):
            self._save_if_due()
        return True

    def _save_if_due(self) -> None:
        n_steps = self.model.num_timesteps - (self._saved_at or 0)
        if n_steps >= self.every or (self._was_asked_to_stop and n_steps > 0):
            self._save()
        if self._was_asked_to_stop:
            self._restore_handler()
            where = f"go on from {self.folder}" if self._saved_at else "nothing was learned yet"
            print(f"Terminated after {self.model.num_timesteps} steps: {where}", file=sys.stderr)
            sys.exit(TERMINATED)

    def _save(self) -> None:
        path = save_checkpoint(self.model, self.folder, self._top, self.keep)
        self._saved_at = self.model.num_timesteps
        if self.verbose >= 1:
            print(f"Checkpoint after {self.model.num_timesteps} steps: {path}")

    def _on_training_end(self) -> None:
        self._restore_handler()
        # A callback may have ended the training in the middle of a rollout
        is_complete = self.model.num_timesteps >= self.model._total_timesteps
        if self.at_end and is_complete and self.model.num_timesteps != self._saved_at:
            self._save()

    def _restore_handler(self) -> None:
        if self._handler_before is not None:
            signal.signal(signal.SIGTERM, self._handler_before)
            self._handler_before = None

    @property
    def _top(self) -> BaseCallback:
        """All callbacks of the training."""
        return self.locals.get("callback", self)
