"""Pictures of a training as it goes: the causal graph, the effects of the actions, the guidance along the denoising chain."""

import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common import logger as sb3_logger
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_causalgdp.callbacks.diagnostics import step_divergences
from sb3_causalgdp.causal.graph import PLOTS_HINT
from sb3_causalgdp.causal.plots import View, plot_action_effects, plot_causal_graph
from sb3_causalgdp.causal.plots.figures import FONT_SIZE, check_choice, save_figure
from sb3_causalgdp.causal.plots.graphs import KINDS
from sb3_causalgdp.causal.plots.view import view_of
from sb3_causalgdp.questions import AskedAlgorithm
from sb3_causalgdp.policies import CausalGDPPolicy

try:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator
except ImportError as error:
    raise ImportError(PLOTS_HINT) from error

TEXT_FORMATS = (sb3_logger.HumanOutputFormat, sb3_logger.JSONOutputFormat, sb3_logger.CSVOutputFormat)
KL_COLOUR = "#2166ac"


class CausalPicturesCallback(BaseCallback):
    """
    Every ``save_freq`` steps, once a causal graph is known, draw

    - ``graph``: the heat map of the effects, or what ``view`` and ``kind`` say;
    - ``effects``: how strongly each action component moves the reward and the next state, on transitions of the replay buffer,
      once the world model has been trained;
    - ``guidance``: how strongly each step of the denoising chain is moved, where the policy is guided.

    TensorBoard shows them as ``pictures/...`` with the logger's next dump. The training is the same with and without it.
    In ``pretrain()`` steps are gradient steps.

    :param save_freq: Steps between pictures, of all environments together
    :param folder: Folder of the image files, such as ``graph_10000_steps.png``, and ``offline/graph_10000_steps.png`` in
        ``pretrain()``; None writes none
    :param batch_size: Transitions on which effects and guidance are computed
    :param verbose: Verbosity level: 1 says when pictures were drawn
    :param kind: Kind of the graph's picture: ``"heat_map"``, ``"graph"`` or ``"both"``
    :param view: What the graph's picture shows: a :class:`~sb3_causalgdp.causal.plots.View`, or its fields by name
    :param budget: Largest share of the training's time that drawing may take, such as 0.01: a picture that is due waits until
        there has been time for it; None sets no limit
    :raises ValueError: If a number is below 1, or a field of the view is not known or out of range
    """

    model: AskedAlgorithm
    # Before the first time is known
    EXPECTED_SECONDS = 1.0

    def __init__(
        self,
        save_freq: int = 10_000,
        folder: str | os.PathLike[str] | None = None,
        batch_size: int = 256,
        verbose: int = 0,
        kind: str = "heat_map",
        view: View | Mapping[str, Any] | None = None,
        budget: float | None = None,
    ) -> None:
        super().__init__(verbose)
        for name, value in (("save_freq", save_freq), ("batch_size", batch_size)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value!r}")
        self.save_freq = save_freq
        self.folder = None if folder is None else Path(folder)
        self.batch_size = batch_size
        check_choice("kind", kind, KINDS)
        self.kind = kind
        self.view = view if isinstance(view, View) else view_of(None, view or {})
        if budget is not None and not 0.0 < budget <= 1.0:
            raise ValueError(f"budget must be a share above 0 and up to 1, or None, got {budget!r}")
        self.budget = budget
        self._last_steps = 0
        self._started = self._seconds = 0.0
        self._expected = self.EXPECTED_SECONDS

    def _init_callback(self) -> None:
        if not isinstance(self.model, AskedAlgorithm):
            raise TypeError(f"CausalPicturesCallback draws a CausalGDP, got {type(self.model).__name__}")
        self._last_steps = self.model.num_timesteps

    def _on_training_start(self) -> None:
        self._started, self._seconds = time.perf_counter(), 0.0
        if not self._has_viewers():
            warnings.warn("CausalPicturesCallback draws nothing: give it a folder, or the model a tensorboard_log")

    def _on_step(self) -> bool:
        # A picture that is due waits for the first graph
        is_due = self.num_timesteps - self._last_steps >= self.save_freq
        if is_due and self.model._causal_graph is not None and self._has_time() and self._has_viewers():
            self._last_steps = self.num_timesteps
            self.draw()
        return True

    def _has_time(self) -> bool:
        if self.budget is None:
            return True
        return self._seconds + self._expected <= self.budget * (time.perf_counter() - self._started)

    def _has_viewers(self) -> bool:
        return self.folder is not None or any(not isinstance(one, TEXT_FORMATS) for one in self.logger.output_formats)

    def draw(self) -> None:
        """
        Draw now.
        """
        start = time.perf_counter()
        with _undisturbed(self.model):
            for name, plot in self._plots():
                figure = plot(self._path(name))
                # With a budget, what TensorBoard would do later is done and counted now
                shown = sb3_logger.Figure(figure, close=False) if self.budget is None else _drawn(figure)
                self.logger.record(f"pictures/{name}", shown, exclude=("stdout", "log", "json", "csv"))
        self._expected = time.perf_counter() - start
        self._seconds += self._expected
        if self.verbose >= 1:
            print(f"Pictures at {self.num_timesteps} steps")

    def _path(self, name: str) -> Path | None:
        if self.folder is None:
            return None
        folder = self.folder / "offline" if self.model.is_pretraining else self.folder
        return folder / f"{name}_{self.num_timesteps}_steps.png"

    def _plots(self) -> Iterator[tuple[str, Callable[[Path | None], Figure]]]:
        model = self.model
        yield "graph", lambda path: plot_causal_graph(model.causal_graph(), path, self.kind, self.view)
        buffer = next((one for one in (model.replay_buffer, model.offline_buffer) if one is not None and one.size() > 0), None)
        if buffer is None:
            # A loaded model starts with an empty buffer
            return
        observations, actions = draw_transitions(buffer, model.policy, self.batch_size)
        if model.policy.world_model.n_batches > 0:
            yield "effects", lambda path: plot_action_effects(model.effect_of_actions(observations, actions), path)
        if model.policy.is_guided:
            divergences = step_divergences(model.policy, policy_input(model, observations)).cpu()
            yield "guidance", lambda path: plot_guidance_strength(divergences, path)


def _drawn(figure: Figure) -> sb3_logger.Image:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return sb3_logger.Image(np.asarray(canvas.buffer_rgba())[..., :3].copy(), "HWC")


def plot_guidance_strength(divergences: th.Tensor | np.ndarray, path: str | os.PathLike[str] | None = None) -> Figure:
    """
    Draw how strongly the guidance moves each step of the denoising chain: bars for the mean over the observations, whiskers
    from the 5th to the 95th percentile.

    :param divergences: KL divergence of each guided step, from k = K down to 1, shape ``(K, batch)``, see
        :func:`~sb3_causalgdp.callbacks.diagnostics.step_divergences`
    :param path: Image file to write, by its suffix; its folder is created; None writes nothing
    :return: the figure
    """
    values = np.asarray(divergences, dtype=np.float64)
    n_steps, n_observations = values.shape
    means = values.mean(axis=1)
    low, high = np.percentile(values, (5, 95), axis=1)
    figure = Figure(figsize=(max(5.0, 2.0 + 0.35 * n_steps), 3.6), layout="constrained")
    axes = figure.add_subplot()
    steps = np.arange(n_steps, 0, -1)
    axes.bar(steps, means, color=KL_COLOUR, width=0.7)
    axes.vlines(steps, low, high, color="black", linewidth=1)
    axes.invert_xaxis()
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylim(bottom=0.0)
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=FONT_SIZE)
    axes.set_xlabel("diffusion step k: from noise (left) to the action (right)", fontsize=FONT_SIZE)
    axes.set_ylabel("KL(guided step || plain step)", fontsize=FONT_SIZE)
    axes.set_title(
        f"Guidance along the denoising chain: {means.sum():.3g} in all\n"
        f"(mean of {n_observations} observations; lines: 5 % to 95 %)",
        fontsize=FONT_SIZE + 1,
    )
    save_figure(figure, path)
    return figure


def draw_transitions(
    buffer: ReplayBuffer, policy: CausalGDPPolicy, n_rows: int, seed: int = 0
) -> tuple[np.ndarray | dict[str, np.ndarray], np.ndarray]:
    """
    Observations and actions from a replay buffer that holds some, as ``effect_of_actions`` takes them. The global random
    generators stay as they are.

    :param buffer: The replay buffer
    :param policy: The policy whose actions it holds
    :param n_rows: At most so many rows, each of them once
    :param seed: Seed of the draw
    :return: Observations as the environment gives them, and the environment's actions
    """
    generator = np.random.default_rng(seed)
    n_held = buffer.size() * buffer.n_envs
    rows, envs = np.divmod(generator.choice(n_held, size=min(n_rows, n_held), replace=False), buffer.n_envs)
    observations: np.ndarray | dict[str, np.ndarray]
    if isinstance(buffer.observations, dict):
        observations = {key: values[rows, envs] for key, values in buffer.observations.items()}
    else:
        observations = buffer.observations[rows, envs]
    actions = buffer.actions[rows, envs].reshape(len(rows), *policy.action_space.shape)  # type: ignore[misc]
    return observations, policy.unscale_action(actions)


def policy_input(model: AskedAlgorithm, observations: np.ndarray | dict[str, np.ndarray]) -> PyTorchObs:
    """
    :param model: The model
    :param observations: A batch of observations, as the environment gives them
    :return: The same as its policy takes them, normalised where ``VecNormalize`` does it
    """
    normalizer = model.get_vec_normalize_env()
    given: Any = observations if normalizer is None else normalizer.normalize_obs(observations)
    return model.policy.obs_to_tensor(given)[0]


@contextmanager
def _undisturbed(model: AskedAlgorithm) -> Iterator[None]:
    """What is drawn from torch's generators inside was not drawn, and the policy is in evaluation mode for a while."""
    was_training = model.policy.training
    devices = [model.device] if model.device.type == "cuda" else []
    with th.random.fork_rng(devices):
        model.policy.set_training_mode(False)
        try:
            yield
        finally:
            model.policy.set_training_mode(was_training)
