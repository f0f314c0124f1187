"""
Draw the figures of the documentation with the package itself: a minute on one core, with the extras plots and mujoco.

    python docs/figures/make_figures.py
    python docs/figures/make_figures.py denoising_chain pendulum_graph
"""

import argparse
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from PIL import Image

from sb3_causalgdp.causal import CausalGraph, MaskedWorldModel, StructuralModel, TransitionVariables, discover
from sb3_causalgdp.causal.plots import plot_heat_map
from sb3_causalgdp.diffusion import NOISE_SCHEDULES, GuidanceRule, NoiseSchedule, sample
from sb3_causalgdp.diffusion.plans import sampling_plan
from sb3_causalgdp.losses import world_model_loss

FOLDER = Path(__file__).parent
DPI = 110
BLUE, RED, GREEN, ORANGE, GREY = "#2166ac", "#b2182b", "#4d9221", "#e08214", "#666666"


def new_figure(width: float, height: float) -> Figure:
    """A figure without pyplot's global state."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def write(figure: Figure, path: Path) -> None:
    """A PNG of 256 colours, which takes half the space."""
    with io.BytesIO() as image:
        figure.savefig(image, dpi=DPI)
        Image.open(image).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
            path, optimize=True
        )


# Data flow --------------------------------------------------------------------------------------------------------------

BOXES = {
    "environment": (0.0, 2.0, "Environment", "s, a, s', r", "#f2f2f2"),
    "buffer": (2.9, 2.0, "Replay buffer", "and preloaded data", "#f2f2f2"),
    "statistics": (5.8, 2.0, "Statistics", "streaming moments", "#d1e5f0"),
    "discovery": (8.7, 2.0, "Causal discovery", "every N steps", "#d1e5f0"),
    "critics": (2.9, 1.0, "Critics", "min of two target Q", "#f2f2f2"),
    "policy": (2.9, 0.0, "Diffusion policy", "K denoising steps", "#fde0b2"),
    "guidance": (5.8, 0.0, "Guidance", r"$\nabla_a \log p(s^*, r^* \mid s, do(a))$", "#d9ecd2"),
    "world_model": (8.7, 0.0, "World model", r"$f(C \odot [s, a]),\ g(U \odot [s', a])$", "#d9ecd2"),
}
BOX_WIDTH, BOX_HEIGHT = 1.9, 0.56
# From, side, to, side, label, where the label lies beside the middle of the arrow
ARROWS = (
    ("environment", "right", "buffer", "left", "transitions", (0.0, 0.1)),
    ("buffer", "right", "statistics", "left", "new rows", (0.0, 0.1)),
    ("statistics", "right", "discovery", "left", "moments", (0.0, 0.1)),
    ("discovery", "bottom", "world_model", "top", "masks\n" + r"$C_{ss}, C_{as}, U_{sr}, U_{ar}$", (0.62, 0.0)),
    ("world_model", "left", "guidance", "right", "Jacobians", (0.0, 0.1)),
    ("guidance", "left", "policy", "right", "noise shift", (0.0, 0.1)),
    ("buffer", "bottom", "critics", "top", "batches\n(for all networks)", (-0.62, 0.0)),
    ("critics", "bottom", "policy", "top", "Q term,\nbest candidate", (-0.55, 0.0)),
)


def draw_data_flow() -> Figure:
    figure = new_figure(10.4, 3.6)
    axes = figure.add_subplot()
    for x, y, title, subtitle, colour in BOXES.values():
        corner = (x - BOX_WIDTH / 2, y - BOX_HEIGHT / 2)
        axes.add_patch(FancyBboxPatch(corner, BOX_WIDTH, BOX_HEIGHT, "round,pad=0.02", facecolor=colour, edgecolor=GREY))
        axes.text(x, y + 0.1, title, ha="center", va="center", fontsize=10, weight="bold")
        axes.text(x, y - 0.14, subtitle, ha="center", va="center", fontsize=8)
    for start, start_side, end, end_side, label, (dx, dy) in ARROWS:
        tail, head = _side(start, start_side), _side(end, end_side)
        _arrow(axes, tail, head)
        axes.text(
            (tail[0] + head[0]) / 2 + dx, (tail[1] + head[1]) / 2 + dy, label, ha="center", va="center", fontsize=8, color=GREY
        )
    # From the policy back to the environment, and from the critics and the buffer to the world's side
    _arrow(axes, _side("policy", "left"), _side("environment", "bottom"), "angle,angleA=180,angleB=90,rad=8")
    axes.text(0.08, 0.75, "action", fontsize=8, color=GREY, ha="left")
    _arrow(axes, _side("critics", "right"), _side("guidance", "top"), "angle,angleA=0,angleB=90,rad=8")
    axes.text(4.75, 1.08, "value of s'", fontsize=8, color=GREY, ha="center")
    axes.set(xlim=(-1.1, 9.95), ylim=(-0.45, 2.45))
    axes.set_axis_off()
    return figure


def _side(box: str, side: str) -> tuple[float, float]:
    x, y = BOXES[box][:2]
    dx, dy = {"left": (-1, 0), "right": (1, 0), "top": (0, 1), "bottom": (0, -1)}[side]
    return x + dx * (BOX_WIDTH / 2 + 0.03), y + dy * (BOX_HEIGHT / 2 + 0.03)


def _arrow(axes: Axes, tail: tuple[float, float], head: tuple[float, float], path: str = "arc3") -> None:
    axes.add_patch(
        FancyArrowPatch(tail, head, connectionstyle=path, arrowstyle="-|>", mutation_scale=11, color="#333333", linewidth=1.1)
    )


# Guided denoising -------------------------------------------------------------------------------------------------------

MODES = th.tensor([[0.55, 0.5], [-0.6, 0.35], [0.0, -0.6]])
MODE_STD = 0.12
DIRECTION, WISH, WISH_STD = th.tensor([0.8, 0.6]), 1.0, 0.25
N_ACTIONS = 400


def exact_noise(schedule: NoiseSchedule) -> Callable[[th.Tensor, int | th.Tensor, th.Tensor], th.Tensor]:
    """The denoiser that a perfectly trained network would be, for a mixture of Gaussians."""

    def predict(noisy: th.Tensor, step: int | th.Tensor, condition: th.Tensor) -> th.Tensor:
        alpha_bar = schedule.alpha_bar_list[int(step)]
        variance = alpha_bar * MODE_STD**2 + 1.0 - alpha_bar
        difference = noisy.unsqueeze(1) - alpha_bar**0.5 * MODES
        weight = th.softmax(-difference.square().sum(dim=2) / (2.0 * variance), dim=1)
        return (1.0 - alpha_bar) ** 0.5 * (weight.unsqueeze(2) * difference).sum(dim=1) / variance

    return predict


def wish(action: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """A linear Gaussian outcome that should be high, as a guidance."""
    error = (WISH - action @ DIRECTION) / WISH_STD**2
    curvature = DIRECTION.outer(DIRECTION) / WISH_STD**2
    return error.unsqueeze(1) * DIRECTION, curvature.expand(len(action), -1, -1)


def run_chain(schedule: NoiseSchedule, rule: GuidanceRule | None) -> np.ndarray:
    """All points of the chains, from noise to action, shape ``(K + 1, N, 2)``."""
    th.manual_seed(3)
    noise = th.randn(schedule.n_steps, N_ACTIONS, 2)
    denoiser, points = exact_noise(schedule), []

    def record(noisy: th.Tensor, step: int | th.Tensor, condition: th.Tensor) -> th.Tensor:
        points.append(noisy.numpy())
        return denoiser(noisy, step, condition)

    actions = sample(record, schedule, th.zeros(N_ACTIONS, 1), None if rule is None else wish, rule, noise=noise)
    return np.stack([*points, actions.numpy()])


def exact_density(grid: th.Tensor, is_guided: bool) -> tuple[np.ndarray, float]:
    """Density at the points of a grid, and the mean outcome."""
    logarithm = th.logsumexp(-(grid.unsqueeze(2) - MODES).square().sum(dim=-1) / (2.0 * MODE_STD**2), dim=-1)
    outcome = grid @ DIRECTION
    if is_guided:
        logarithm = logarithm - (outcome - WISH).square() / (2.0 * WISH_STD**2)
    density = logarithm.exp()
    density = density / density.sum()
    return density.numpy(), float((density * outcome).sum())


def draw_denoising_chain() -> Figure:
    schedule = NoiseSchedule("vp", 5)
    values = th.linspace(-2.0, 2.0, 321)
    grid = th.stack(th.meshgrid(values, values, indexing="xy"), dim=-1)
    rows = (
        ("guidance=None", None),
        ('guidance="posterior"', GuidanceRule("posterior")),
        ('guidance="score"', GuidanceRule("score")),
    )
    figure = new_figure(10.4, 5.7)
    all_axes = figure.subplots(len(rows), schedule.n_steps + 1, sharex=True, sharey=True)
    for (label, rule), row in zip(rows, all_axes, strict=True):
        chain = run_chain(schedule, rule)
        density, exact = exact_density(grid, rule is not None)
        for position, axes in enumerate(row):
            is_action = position == schedule.n_steps
            axes.scatter(*chain[position].T, s=3, color=BLUE if is_action else ORANGE, alpha=0.5, linewidth=0)
            levels = density.max() * np.array([0.03, 0.4])
            axes.contour(values, values, density, levels=levels, colors=GREEN, linewidths=0.9, zorder=0 if is_action else -1)
            if rule is not None:
                # Where the outcome is as wished for
                ends = np.array([-2.5, 2.5])
                line = (WISH - float(DIRECTION[0]) * ends) / float(DIRECTION[1])
                axes.plot(ends, line, color=GREY, linestyle="--", linewidth=0.8)
            axes.set(xlim=(-2.0, 2.0), ylim=(-2.0, 2.0), aspect="equal", xticks=(-1, 0, 1), yticks=(-1, 0, 1))
            axes.tick_params(labelsize=7)
        row[0].set_ylabel(label, fontsize=9)
        mean = float((chain[-1] @ DIRECTION.numpy()).mean())
        row[-1].text(-1.9, -1.85, f"mean outcome {mean:.2f}\nexact {exact:.2f}", fontsize=7.5)
    for position, axes in enumerate(all_axes[0]):
        k = schedule.n_steps - position
        axes.set_title("noise, k = 5" if position == 0 else "action, k = 0" if k == 0 else f"k = {k}", fontsize=9)
    return figure


# Guidance against the exact posterior --------------------------------------------------------------------------------------

STEPS = (3, 5, 10, 20, 50, 100)
N_SYSTEMS = 20
RULES = {
    "posterior, tweedie": (GuidanceRule("posterior", "tweedie"), GREEN),
    "posterior, isotropic": (GuidanceRule("posterior", "isotropic"), BLUE),
    "posterior, unit_gaussian": (GuidanceRule("posterior", "unit_gaussian"), ORANGE),
    "score (plain gradient)": (GuidanceRule("score"), RED),
}


class LinearGaussian:
    """A Gaussian prior over three action components, and four linear observations of them that were made."""

    def __init__(self, seed: int) -> None:
        generator = th.Generator().manual_seed(seed)

        def draw(*shape: int) -> th.Tensor:
            return th.randn(shape, generator=generator, dtype=th.float64)

        root = 0.3 * draw(3, 3)
        self.mean, self.covariance = 0.3 * draw(3), root @ root.T + 0.01 * th.eye(3, dtype=th.float64)
        self.observe, self.precision = draw(4, 3), (0.2 + 0.3 * draw(4).abs()).pow(-2).diag()
        action = self.mean + th.linalg.cholesky(self.covariance) @ draw(3)
        self.outcome = self.observe @ action + self.precision.diagonal().rsqrt() * draw(4)
        self.curvature = self.observe.T @ self.precision @ self.observe

    def guidance(self, action: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        error = self.outcome - action @ self.observe.T
        return error @ self.precision @ self.observe, self.curvature.expand(len(action), 3, 3)

    def denoiser(self, schedule: NoiseSchedule) -> Callable[[th.Tensor, int | th.Tensor, th.Tensor], th.Tensor]:
        def predict(noisy: th.Tensor, step: int | th.Tensor, condition: th.Tensor) -> th.Tensor:
            alpha_bar = schedule.alpha_bar_list[int(step)]
            covariance = alpha_bar * self.covariance + (1.0 - alpha_bar) * th.eye(3, dtype=th.float64)
            return (1.0 - alpha_bar) ** 0.5 * (noisy - alpha_bar**0.5 * self.mean) @ th.linalg.inv(covariance)

        return predict

    def error(self, schedule: NoiseSchedule, rule: GuidanceRule) -> float:
        """Distance of the chain's mean from the posterior's, in standard deviations of the prior."""
        prior_precision = th.linalg.inv(self.covariance)
        right_side = prior_precision @ self.mean + self.observe.T @ self.precision @ self.outcome
        exact = th.linalg.solve(prior_precision + self.curvature, right_side)
        # Everything is linear: the chain without noise is the mean of all chains
        noise, condition = th.zeros(schedule.n_steps, 1, 3, dtype=th.float64), th.zeros(1, 1, dtype=th.float64)
        mean = sample(self.denoiser(schedule), schedule, condition, self.guidance, rule, noise=noise, clip=None)[0]
        whitened = th.linalg.solve_triangular(th.linalg.cholesky(self.covariance), (mean - exact).unsqueeze(1), upper=False)
        return float(whitened.norm())


def draw_guidance_error() -> Figure:
    figure = new_figure(6.4, 3.4)
    axes = figure.add_subplot()
    systems = [LinearGaussian(seed) for seed in range(N_SYSTEMS)]
    for label, (rule, colour) in RULES.items():
        errors = np.array([[one.error(NoiseSchedule("vp", n_steps), rule) for one in systems] for n_steps in STEPS])
        axes.plot(STEPS, np.median(errors, axis=1), color=colour, marker="o", markersize=3, label=label)
        axes.fill_between(STEPS, errors.min(axis=1), errors.max(axis=1), color=colour, alpha=0.15, linewidth=0)
    axes.set(xscale="log", yscale="log", ylim=(1e-4, 1e4))
    axes.set_xticks(STEPS, [str(n_steps) for n_steps in STEPS])
    axes.minorticks_off()
    axes.set_xlabel("diffusion steps K", fontsize=9)
    axes.set_ylabel("error of the mean,\nin prior standard deviations", fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8, frameon=False)
    return figure


# Samplers ---------------------------------------------------------------------------------------------------------------

SAMPLER_STEPS = (3, 5, 10, 20, 40)
SAMPLER_COLOURS = {"ddpm": GREY, "ddim": ORANGE, "euler_maruyama": BLUE, "heun": RED, "dpm_solver": GREEN}


def posterior_distance(system: LinearGaussian, schedule: NoiseSchedule, sampler: str) -> float:
    """Wasserstein distance of guided samples from the posterior, in standard deviations of the prior."""
    n_noises = 3 * schedule.n_steps
    noise = th.cat([th.zeros(1, n_noises, dtype=th.float64), th.eye(n_noises, dtype=th.float64)])
    noise = noise.view(n_noises + 1, schedule.n_steps, 3).transpose(0, 1)
    rule = GuidanceRule("posterior", "tweedie")
    # A sample is affine in its noise, so its mean and covariance can be read off
    ends = sample(
        system.denoiser(schedule), schedule, noise[0], system.guidance, rule, noise=noise, clip=None, sampler=sampler
    )
    prior_precision = th.linalg.inv(system.covariance)
    covariance = th.linalg.inv(prior_precision + system.curvature)
    mean = covariance @ (prior_precision @ system.mean + system.observe.T @ system.precision @ system.outcome)
    root = th.linalg.inv(th.linalg.cholesky(system.covariance))
    columns = (ends[1:] - ends[0]) @ root.T
    ours, exact = columns.T @ columns, root @ covariance @ root.T
    product = th.linalg.eigvals(ours @ exact).real.clamp(min=0.0).sqrt().sum()
    return float(
        ((root @ (ends[0] - mean)).square().sum() + ours.trace() + exact.trace() - 2.0 * product).clamp(min=0.0).sqrt()
    )


def mixture_distance(schedule: NoiseSchedule, sampler: str, n_samples: int = 4_000) -> float:
    """Wasserstein distance of samples from a policy with two modes."""
    weights, means, stds = th.tensor([0.4, 0.6]), th.tensor([-0.6, 0.5]), th.tensor([0.1, 0.15])

    def predict(noisy: th.Tensor, step: int | th.Tensor, condition: th.Tensor) -> th.Tensor:
        alpha_bar = schedule.alpha_bar_list[int(step)]
        centred, variances = noisy - alpha_bar**0.5 * means, alpha_bar * stds**2 + 1.0 - alpha_bar
        share = (weights.log() - 0.5 * centred**2 / variances - 0.5 * variances.log()).softmax(dim=1)
        return (1.0 - alpha_bar) ** 0.5 * (share * centred / variances).sum(dim=1, keepdim=True)

    th.manual_seed(0)
    ends = sample(predict, schedule, th.zeros(n_samples, 1), action_dim=1, sampler=sampler)
    grid = th.linspace(-1.5, 1.5, 3_001)
    of_samples = th.searchsorted(ends[:, 0].sort().values, grid) / n_samples
    exact = (weights * th.distributions.Normal(means, stds).cdf(grid[:, None])).sum(dim=1)
    return float((of_samples - exact).abs().mean() * 3.0)


def draw_samplers() -> Figure:
    figure = new_figure(9.6, 3.3)
    systems = [LinearGaussian(seed) for seed in range(N_SYSTEMS)]
    panels: dict[str, Callable[[int, str], float]] = {
        "guided, vp": lambda n, name: float(
            np.median([posterior_distance(one, NoiseSchedule("vp", n), name) for one in systems])
        ),
        "guided, cosine": lambda n, name: float(
            np.median([posterior_distance(one, NoiseSchedule("cosine", n), name) for one in systems])
        ),
        "two modes, vp": lambda n, name: mixture_distance(NoiseSchedule("vp", n), name),
    }
    for index, (title, distance) in enumerate(panels.items()):
        axes = figure.add_subplot(1, 3, index + 1)
        for sampler, colour in SAMPLER_COLOURS.items():
            name = title.rpartition(" ")[2]
            costs = [len(sampling_plan(NoiseSchedule(name, n), sampler)) for n in SAMPLER_STEPS]
            axes.plot(
                costs, [distance(n, sampler) for n in SAMPLER_STEPS], color=colour, marker="o", markersize=3, label=sampler
            )
        ticks = (3, 5, 10, 20, 40, 80)
        axes.set(xscale="log", yscale="log")
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("evaluations of the denoiser", fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
        if index == 0:
            axes.set_ylabel("Wasserstein distance\nfrom what is exact", fontsize=9)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize=8, frameon=False)
    return figure


# Graphs of real environments --------------------------------------------------------------------------------------------


def random_transitions(env_id: str, n_rows: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Observations, actions in [-1, 1], next observations and rewards under uniform actions."""
    env = gym.make(env_id)
    rng = np.random.default_rng(seed)
    assert isinstance(env.action_space, gym.spaces.Box)
    low, high = env.action_space.low, env.action_space.high
    observation, _ = env.reset(seed=seed)
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, float]] = []
    while len(rows) < n_rows:
        action = rng.uniform(-1.0, 1.0, low.shape)
        following, reward, terminated, truncated, _ = env.step((low + (action + 1.0) / 2.0 * (high - low)).astype(low.dtype))
        rows.append((observation, action, following, float(reward)))
        observation = env.reset()[0] if terminated or truncated else following
    return tuple(np.array(column) for column in zip(*rows, strict=True))


PENDULUM = TransitionVariables(("cos", "sin", "velocity"), ("torque",))
JOINTS = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
POSITIONS = ("height", "pitch", *JOINTS)
HALF_CHEETAH = TransitionVariables(
    (*POSITIONS, "v x", "v z", *(f"v {name}" for name in POSITIONS[1:])), tuple(f"torque {name}" for name in JOINTS)
)


def mujoco_variables(env_id: str) -> TransitionVariables:
    """Names from the simulator's joints and bodies, in the order of the observations of Gymnasium's Ant and Humanoid."""
    env: Any = gym.make(env_id).unwrapped
    model, structure = env.model, env.observation_structure
    bodies = [model.body(i).name or f"link {i}" for i in range(1, model.nbody)]
    joints = [model.joint(i).name for i in range(1, model.njnt)]
    positions = [*(f"root {name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz")), *joints]
    names = [
        *positions[structure["skipped_qpos"] :],
        *(f"vel root {name}" for name in ("x", "y", "z", "rx", "ry", "rz")),
        *(f"vel {joint}" for joint in joints),
        *(f"cinert {body}[{i}]" for body in bodies for i in range(10) if structure.get("cinert", 0)),
        *(f"cvel {body}[{i}]" for body in bodies for i in range(6) if structure.get("cvel", 0)),
        *(f"force {joint}" for joint in joints if structure.get("qfrc_actuator", 0)),
        *(f"cfrc_ext {body}[{i}]" for body in bodies for i in range(6)),
    ]
    actions = tuple(f"torque {model.joint(joint).name}" for joint in model.actuator_trnid[:, 0])
    return TransitionVariables(tuple(names), actions)


def graph_of(env_id: str, variables: TransitionVariables, n_rows: int = 5_000) -> CausalGraph:
    return discover("partial_r2", variables.stack(*random_transitions(env_id, n_rows)), variables)


def plant_graph() -> CausalGraph:
    """A table of 300 columns: eight machines with 35 sensors each, 20 settings, every third sensor moved by one of them."""
    rng = np.random.default_rng(0)
    machines, kinds = ("tank", "pump", "valve", "boiler", "mixer", "column", "heater", "line"), ("level", "flow", "heat")
    sensors = [f"{machine} {kinds[i % 3]} {i // 3}" for machine in machines for i in range(35)]
    settings = [f"set {machine} {i}" for machine in machines[:5] for i in range(4)]
    state, rows = np.zeros(280), []
    for _ in range(4_000):
        setting = rng.uniform(-1.0, 1.0, 20)
        following = 0.7 * state + 0.3 * rng.normal(size=280)
        following[::3] += 0.8 * setting[np.arange(94) * 20 // 94]
        following[35:] += 0.3 * state[:-35] * (np.arange(245) % 5 == 0)
        rows.append(np.concatenate([state, setting, [following[0] - following[140] + following[245]]]))
        state = following
    columns = dict(zip([*sensors, *settings, "yield"], np.array(rows).T, strict=True))
    return discover(columns, states=sensors, actions=settings, reward="yield")


def draw_pendulum_graph() -> Figure:
    return graph_of("Pendulum-v1", PENDULUM, 10_000).plot()


def draw_halfcheetah_graph() -> Figure:
    return graph_of("HalfCheetah-v5", HALF_CHEETAH).plot()


def draw_ant_graph() -> Figure:
    return graph_of("Ant-v5", mujoco_variables("Ant-v5")).plot()


def draw_humanoid_graph() -> Figure:
    return graph_of("Humanoid-v5", mujoco_variables("Humanoid-v5")).plot(kind="graph")


def draw_table_graph() -> Figure:
    return plant_graph().plot()


def draw_halfcheetah_effects() -> Figure:
    figure = new_figure(8.6, 6.4)
    plot_heat_map(graph_of("HalfCheetah-v5", HALF_CHEETAH, 20_000), figure.add_subplot())
    return figure


# Counterfactual ---------------------------------------------------------------------------------------------------------

N_STEPS = 60


def fitted_world_model(transitions: Sequence[np.ndarray], variables: TransitionVariables, steps: int) -> MaskedWorldModel:
    """Discovery, masks and a fit by maximum likelihood, as the algorithm does them."""
    th.manual_seed(0)
    graph = discover("partial_r2", variables.stack(*transitions), variables)
    world_model = MaskedWorldModel(variables.n_states, variables.n_actions)
    masks = (graph.state_to_state, graph.action_to_state, graph.state_to_reward, graph.action_to_reward)
    world_model.set_masks(*(th.as_tensor(mask, dtype=th.float32) for mask in masks))
    tensors = [th.as_tensor(column, dtype=th.float32) for column in transitions]
    optimizer = th.optim.Adam(world_model.parameters(), lr=2e-3)
    schedule = th.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        index = th.randint(len(tensors[0]), (256,))
        state, action, next_state, reward = (tensor[index] for tensor in tensors)
        world_model.update_statistics(state, next_state, reward)
        transition_loss, reward_loss = world_model_loss(world_model, state, action, next_state, reward)
        optimizer.zero_grad()
        (transition_loss + reward_loss).backward()
        optimizer.step()
        schedule.step()
    return world_model


def pendulum_episode(torques: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Observations and rewards of the real environment from one start."""
    env = gym.make("Pendulum-v1")
    observation, _ = env.reset(seed=5)
    observations, rewards = [observation], []
    for torque in torques:
        observation, reward, *_ = env.step(np.array([torque], dtype=np.float32))
        observations.append(observation)
        rewards.append(float(reward))
    return np.array(observations), np.array(rewards)


def draw_counterfactual() -> Figure:
    world_model = fitted_world_model(random_transitions("Pendulum-v1", 20_000), PENDULUM, 4_000)
    model = StructuralModel(world_model, PENDULUM, action_low=-2.0, action_high=2.0)
    recorded_torque = 2.0 * np.sin(0.25 * np.arange(N_STEPS))
    observations, rewards = pendulum_episode(recorded_torque)
    answer = model.counterfactual((observations, recorded_torque[:, None], rewards), {"torque": -1.0})
    truth, _ = pendulum_episode(np.full(N_STEPS, -1.0))
    figure = new_figure(8.0, 2.9)
    for index, (column, label) in enumerate(((2, "velocity"), (0, "cos"))):
        axes = figure.add_subplot(1, 2, index + 1)
        axes.plot(observations[:, column], color=GREY, label="recorded")
        axes.plot(truth[:, column], color=GREEN, linewidth=3, alpha=0.6, label="torque = -1, simulator")
        axes.plot(answer.states[:, column], color=RED, linestyle="--", label="torque = -1, counterfactual")
        axes.set_xlabel("step", fontsize=9)
        axes.set_ylabel(label, fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=8, frameon=False)
    return figure


# Noise schedules --------------------------------------------------------------------------------------------------------


def draw_noise_schedules() -> Figure:
    figure = new_figure(7.0, 2.6)
    for index, n_steps in enumerate((5, 50)):
        axes = figure.add_subplot(1, 2, index + 1)
        for name, colour in zip(NOISE_SCHEDULES, (BLUE, ORANGE, GREEN), strict=True):
            share = [1.0, *NoiseSchedule(name, n_steps).alpha_bar_list]
            axes.plot(share, color=colour, marker="o" if n_steps < 20 else None, markersize=3, label=name)
        axes.set_xlabel(f"diffusion step k (K = {n_steps})", fontsize=9)
        axes.set_ylabel(r"signal left $\bar\alpha_k$", fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].legend(fontsize=8, frameon=False)
    return figure


# What causal abstraction earns ------------------------------------------------------------------------------------------

BENCHMARKS = FOLDER.parents[1] / "benchmarks"
# Of each panel: title, and for each curve the files' names and what they are
DISTRACTION = {
    "HalfCheetah-v5 with 100 noise observations": {
        "causal/results/HalfCheetah-v5_noise-0.2_m100_k0": ("CausalGDP, sees what matters", BLUE),
        "causal/results/HalfCheetah-v5_noise-0.2_sees_all_m100_k0": ("CausalGDP, sees everything", RED),
        "causal/results/HalfCheetah-v5_sac_m100_k0": ("SAC", GREY),
    },
    "Ant-v5 (105 observations)": {
        "learning/results/Ant-v5_previous": ("CausalGDP, sees what matters", BLUE),
        "learning/results/Ant-v5_previous_sees_all": ("CausalGDP, sees everything", RED),
    },
}


def draw_distractors() -> Figure:
    """One line for each seed of the learning benchmark."""
    figure = new_figure(8.4, 3.2)
    for index, (title, curves) in enumerate(DISTRACTION.items()):
        axes = figure.add_subplot(1, 2, index + 1)
        for files, (label, colour) in curves.items():
            for number, path in enumerate(sorted(BENCHMARKS.glob(f"{files}_[0-9].csv"))):
                steps, returns = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(0, 1), unpack=True)
                axes.plot(steps / 1000, returns, color=colour, label=label if number == 0 else None)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("environment steps (thousands)", fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("return", fontsize=9)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=8, frameon=False)
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    "distractors": draw_distractors,
    "data_flow": draw_data_flow,
    "denoising_chain": draw_denoising_chain,
    "guidance_error": draw_guidance_error,
    "noise_schedules": draw_noise_schedules,
    "samplers": draw_samplers,
    "pendulum_graph": draw_pendulum_graph,
    "halfcheetah_effects": draw_halfcheetah_effects,
    "halfcheetah_graph": draw_halfcheetah_graph,
    "ant_graph": draw_ant_graph,
    "humanoid_graph": draw_humanoid_graph,
    "table_graph": draw_table_graph,
    "counterfactual": draw_counterfactual,
}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figures", nargs="*", metavar="FIGURE", help=f"all by default: {', '.join(FIGURES)}")
    chosen = parser.parse_args().figures or list(FIGURES)
    unknown = sorted(set(chosen) - set(FIGURES))
    if unknown:
        parser.error(f"unknown figures {unknown}, known are {list(FIGURES)}")
    # For networks this small, more threads only wait for each other
    th.set_num_threads(1)
    for name in chosen:
        path = FOLDER / f"{name}.png"
        write(FIGURES[name](), path)
        print(f"{path}: {path.stat().st_size / 1024:.0f} KiB", flush=True)
