"""Policies in files that run without this package: ONNX, TorchScript, PyTorch's exported programs."""

import copy
import importlib
import itertools
import json
import logging
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn
from torch.fx import GraphModule
from torch.fx.experimental.proxy_tensor import make_fx
from torch.fx.node import map_arg

from sb3_causalgdp.causal import TransitionVariables
from sb3_causalgdp.files import replaced_when_done
from sb3_causalgdp.hints import how_to_install
from sb3_causalgdp.prediction import act_in_torch, choice_noise, draws_candidates

Policy = Any  # a CausalGDPPolicy, whose file imports this one
Arrays = list[np.ndarray]

EXPORT_HINT = how_to_install("export")
METADATA = "metadata.json"
"""The key of what a file tells of itself, as JSON."""
# A file whose actions typically differ by more, in half ranges of the action space, is not written
LARGEST_DIFFERENCE = 1e-4
N_CHECKED = 16
# Rows of a second check, which finds what was traced for the number of the first
N_FEWER = 7


def export_policy(
    policy: Policy,
    path: str | os.PathLike[str],
    variables: TransitionVariables,
    guided: bool | None = None,
    deterministic: bool = True,
    vec_normalize: VecNormalize | None = None,
) -> None:
    """
    Write what ``predict`` computes to a file that runs without this package, and compare the two.

    :param policy: The policy
    :param path: The file; its suffix says of which kind: ``.onnx``, ``.pt`` (TorchScript) or ``.pt2`` (``torch.export``)
    :param variables: Names of states and actions, for the metadata
    :param guided: Whether actions are steered by the causal guidance, None for what ``predict`` does now
    :param deterministic: Whether the candidates' noise is fixed; if not, noise is an input beside the observation
    :param vec_normalize: What normalises the policy's observations: the file then takes them as they are before
    :raises ValueError: If the suffix is unknown, there is no guidance yet, or the policy cannot be traced
    :raises ImportError: If a package for ONNX is missing
    :raises RuntimeError: If the file gives other actions than ``predict``
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _WRITERS:
        raise ValueError(f"path must end in one of {sorted(_WRITERS)}, got {str(path)!r}")
    if suffix == ".onnx":
        _need_onnx()
    guided = policy.is_guided if guided is None else guided
    if guided and not policy.is_guided:
        why = (
            "its guidance is off" if policy.guidance_rule is None else "no causal graph has been found yet: let it learn first"
        )
        raise ValueError(f"guided must be False or None for this policy, got True: {why}")
    acting = ExportedPolicy(policy, guided, deterministic, vec_normalize)
    arrays, actions = acting.examples()
    program = _traced(acting, arrays, keeps_solver=suffix != ".onnx")
    _check(acting, arrays, actions, lambda arrays: program(*map(th.as_tensor, arrays)).numpy())
    metadata = json.dumps(acting.metadata(variables), indent=1)
    with replaced_when_done(path) as temporary, _quiet():
        exported = _WRITERS[suffix](program, acting, arrays, metadata, temporary)
        if exported is not None:
            _check(acting, arrays, actions, exported)


class ExportedPolicy(nn.Module):
    """
    A policy's deterministic or noisy prediction, from the observations of the environment to its actions.

    :param policy: The policy, of which a copy is made
    :param guided: Whether actions are steered
    :param deterministic: Whether the noise is fixed, and not an input
    :param vec_normalize: Normalises the policy's observations, None for none
    :raises ValueError: If the observations change between the normalisation and the policy
    """

    action_low: th.Tensor
    action_high: th.Tensor

    def __init__(self, policy: Policy, guided: bool, deterministic: bool, vec_normalize: VecNormalize | None = None) -> None:
        super().__init__()
        optimizers = (network.optimizer for network in (policy.actor, policy.critic, policy.world_model))
        # Without the optimizers' states, which are twice as large
        self.policy = copy.deepcopy(policy, {id(optimizer): None for optimizer in optimizers}).to("cpu").requires_grad_(False)
        self.policy.set_training_mode(False)
        self.policy.guidance_ready.fill_(float(guided))
        if self.policy.guidance_rule is not None:
            self.policy.guidance_rule.differentiates_forwards = False
        self.guided = guided
        self.deterministic = deterministic
        self.explores = not deterministic and policy.exploration_noise > 0.0
        self.draws = draws_candidates(policy, deterministic)
        self.normalizer = vec_normalize if vec_normalize is not None and vec_normalize.norm_obs else None
        space = policy.observation_space if self.normalizer is None else _space_below(self.normalizer, policy)
        self.is_dict = isinstance(space, spaces.Dict)
        self.spaces: dict[str, spaces.Space] = dict(space.spaces) if isinstance(space, spaces.Dict) else {"observation": space}
        for index, key in enumerate(self.spaces):
            for name, value in zip(("mean", "std"), self._statistics(key), strict=True):
                self.register_buffer(f"{name}_{index}", value)
        self.register_buffer("action_low", th.as_tensor(policy.action_space.low.copy()))
        self.register_buffer("action_high", th.as_tensor(policy.action_space.high.copy()))

    def _statistics(self, key: str) -> tuple[th.Tensor | None, th.Tensor | None]:
        """Mean and standard deviation of a part of the observation in double precision, as ``VecNormalize`` computes."""
        if self.normalizer is None or (self.is_dict and key not in (self.normalizer.norm_obs_keys or ())):
            return None, None
        of_all: Any = self.normalizer.obs_rms
        statistics = of_all[key] if self.is_dict else of_all
        std = np.sqrt(statistics.var + self.normalizer.epsilon)
        return th.as_tensor(np.array(statistics.mean, np.float64)), th.as_tensor(np.array(std, np.float64))

    @property
    def noise_shapes(self) -> dict[str, tuple[int, ...]]:
        """Of the noise of one observation, by the names of the inputs."""
        n_steps, n_candidates, action_dim = self.policy.candidate_noise.shape
        shapes: dict[str, tuple[int, ...]] = {}
        if not self.deterministic:
            shapes["noise"] = (n_steps, n_candidates, action_dim)
        if self.draws:
            shapes["choice_noise"] = (n_candidates,)
        return {**shapes, "exploration_noise": (action_dim,)} if self.explores else shapes

    @property
    def input_names(self) -> list[str]:
        """Of the parts of the observation, then of the noise."""
        return [*self.spaces, *self.noise_shapes]

    def forward(self, *inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: In the order of :attr:`input_names`, each with the batch first
        :return: Actions in the environment's units, shape ``(batch, *shape)``
        """
        observation, noise = self._observation(inputs), self.policy.candidate_noise
        if self.deterministic:
            noise = noise.unsqueeze(1).expand(-1, inputs[0].shape[0], -1, -1)
        else:
            noise = inputs[len(self.spaces)].transpose(0, 1)
        features = self.policy.acting_actor(self.deterministic).features(observation)
        how = (self.deterministic, self.guided, inputs[len(self.spaces) + 1] if self.draws else None)
        action = act_in_torch(self.policy, observation, features, noise.flatten(1, 2), *how)
        if self.explores:
            action = (action + self.policy.exploration_noise * inputs[-1]).clamp(-1.0, 1.0)
        action = action.reshape(-1, *self.action_low.shape)
        # As SB3's unscale_action
        return self.action_low + 0.5 * (action + 1.0) * (self.action_high - self.action_low)

    def _observation(self, inputs: Sequence[th.Tensor]) -> PyTorchObs:
        parts = {key: self._normalized(index, inputs[index]) for index, key in enumerate(self.spaces)}
        return parts if self.is_dict else parts["observation"]

    def _normalized(self, index: int, values: th.Tensor) -> th.Tensor:
        mean, std = getattr(self, f"mean_{index}"), getattr(self, f"std_{index}")
        if mean is None:
            return values
        assert self.normalizer is not None
        bound = float(self.normalizer.clip_obs)
        return ((values.double() - mean) / std).clamp(-bound, bound).float()

    def examples(self) -> tuple[Arrays, np.ndarray]:
        """
        :return: Inputs, and what ``predict`` gives for them
        """
        sizes = {size for name in self.input_names for size in self._shape(name)}
        # PyTorch takes dimensions of one size for one dimension
        n_rows = next(size for size in itertools.count(N_CHECKED) if size not in sizes)
        parts = self._observations(n_rows)
        observation: Any = parts if self.is_dict else parts["observation"]
        if self.normalizer is not None:
            observation = self.normalizer.normalize_obs(observation)
        with th.random.fork_rng(devices=[]):
            th.manual_seed(0)
            actions, _ = self.policy.predict(observation, deterministic=self.deterministic)
            th.manual_seed(0)
            noise = self._drawn_noise(n_rows)
        return [*parts.values(), *noise], actions

    def _observations(self, n_rows: int) -> dict[str, np.ndarray]:
        """About as the policy has seen them: far from there the guidance of a young world model makes much of rounding."""
        world_model = self.policy.world_model
        starts = np.cumsum([0, *(spaces.flatdim(space) for space in self.spaces.values())])
        # Otherwise the states are features of images
        is_state = self.normalizer is None and starts[-1] == len(world_model.state_mean)
        parts = {}
        for key, (start, end) in zip(self.spaces, itertools.pairwise(starts), strict=True):
            mean, std = self._statistics(key)
            if is_state:
                mean, std = world_model.state_mean[start:end], world_model.state_std[start:end]
            parts[key] = _examples_of(self.spaces[key], n_rows, 0.0 if mean is None else mean, 1.0 if std is None else std)
        return parts

    def _drawn_noise(self, n_rows: int) -> Arrays:
        """As ``predict`` draws it."""
        shapes = self.noise_shapes
        if not shapes:
            return []
        n_steps, n_candidates, action_dim = shapes["noise"]
        drawn = th.randn(n_steps, n_rows * n_candidates, action_dim)
        of_all = [drawn.view(n_steps, n_rows, n_candidates, action_dim).transpose(0, 1).contiguous()]
        of_choice = choice_noise(self.policy, n_rows, self.deterministic)
        if of_choice is not None:
            of_all.append(of_choice)
        if self.explores:
            of_all.append(th.randn(n_rows, action_dim))
        return [tensor.numpy() for tensor in of_all]

    def _shape(self, name: str) -> tuple[int, ...]:
        return self.noise_shapes[name] if name in self.noise_shapes else self.spaces[name].shape  # type: ignore[return-value]

    def metadata(self, variables: TransitionVariables) -> dict[str, Any]:
        """
        :param variables: Names of states and actions
        :return: What a file tells of itself, of plain values
        """
        action_space = self.policy.action_space
        dtypes = {name: str(space.dtype) for name, space in self.spaces.items()}
        return {
            "inputs": [
                {"name": name, "dtype": dtypes.get(name, "float32"), "shape": ["batch", *self._shape(name)]}
                for name in self.input_names
            ],
            "action": {
                "shape": ["batch", *action_space.shape],
                "low": action_space.low.tolist(),
                "high": action_space.high.tolist(),
            },
            "observation_space": {name: str(space) for name, space in self.spaces.items()},
            "state_names": list(variables.state_names),
            "action_names": list(variables.action_names),
            "guided": self.guided,
            "deterministic": self.deterministic,
            "normalizes_observations": self.normalizer is not None,
            "versions": {
                "sb3_causalgdp": Path(__file__).with_name("version.txt").read_text(encoding="utf-8").strip(),
                "stable_baselines3": stable_baselines3.__version__,
                "torch": str(th.__version__),
            },
        }


def _space_below(normalizer: VecNormalize, policy: Policy) -> spaces.Space:
    """The space of the observations that are normalised."""
    shapes = [
        {key: part.shape for key, part in space.spaces.items()} if isinstance(space, spaces.Dict) else space.shape
        for space in (normalizer.observation_space, policy.observation_space)
    ]
    if shapes[0] != shapes[1]:
        raise ValueError(
            f"Observations of shape {shapes[0]} are normalised, and the policy sees {shapes[1]}, as behind VecFrameStack: "
            "export with vec_normalize=None, and normalise them outside"
        )
    return normalizer.venv.observation_space


def _examples_of(space: spaces.Space, n_rows: int, mean: th.Tensor | float, std: th.Tensor | float) -> np.ndarray:
    """Different rows of a space, the same at every call; of floating-point numbers around a mean."""
    space = copy.deepcopy(space)
    space.seed(0)
    rows = np.stack([space.sample() for _ in range(n_rows)])
    if isinstance(space, spaces.Box) and np.issubdtype(rows.dtype, np.floating):
        # Not from bounds that may be as far away as numbers go
        middle, spread = (np.broadcast_to(np.ravel(value), rows[0].size).reshape(space.shape) for value in (mean, std))
        rows = middle + spread * np.random.default_rng(0).normal(size=rows.shape)
        rows = np.clip(rows, space.low, space.high).astype(space.dtype)
    return rows


def _check(acting: ExportedPolicy, arrays: Arrays, actions: np.ndarray, exported: Callable[[Arrays], np.ndarray]) -> None:
    """With all rows, and with fewer."""
    _check_same(acting, actions, exported(arrays))
    try:
        of_fewer = exported([array[:N_FEWER] for array in arrays])
    except Exception as error:
        raise ValueError(
            "The policy cannot be exported, because a network in it fixes the number of rows: where a forward() of your own "
            "takes len(x) of a tensor, take x.shape[0]"
        ) from error
    _check_same(acting, actions[:N_FEWER], of_fewer)


def _check_same(acting: ExportedPolicy, actions: np.ndarray, exported: np.ndarray) -> None:
    """In the median: of two candidates that are as good as each other, rounding chooses."""
    half_range = (acting.action_high - acting.action_low).numpy() / 2.0
    difference = np.abs((exported - actions) / half_range).reshape(len(actions), -1).max(axis=1)
    if not np.median(difference) <= LARGEST_DIFFERENCE:
        raise RuntimeError(
            f"The exported policy's actions differ from predict's by {np.median(difference):.2g} half ranges of the action "
            "space: nothing was written. A policy with a predict() or forward() of its own cannot be exported"
        )


# Tracing ---------------------------------------------------------------------------------------------------------------


def _traced(acting: ExportedPolicy, arrays: Arrays, keeps_solver: bool) -> GraphModule:
    """The forward pass as a list of PyTorch's operators, the backward pass of the guidance in it, for every batch size."""
    table = {} if keeps_solver else {th.ops.aten._linalg_solve_ex.default: _solve_by_elimination}
    try:
        with th.no_grad():
            program = make_fx(acting, decomposition_table=table, tracing_mode="symbolic", _allow_non_fake_inputs=True)(
                *map(th.as_tensor, arrays)
            )
    except Exception as error:
        raise ValueError(f"The policy cannot be exported: {type(error).__name__}: {str(error).strip()}") from error
    return _without_constants(program)


def _without_constants(program: GraphModule) -> GraphModule:
    """What no input moves is computed now: half of the operators."""
    known: dict[th.fx.Node, Any] = {}
    for node in program.graph.nodes:
        if node.op == "get_attr":
            known[node] = getattr(program, node.target)
        elif node.op == "call_function" and all(argument in known for argument in node.all_input_nodes):
            known[node] = node.target(*map_arg(node.args, known.get), **map_arg(node.kwargs, known.get))
    for node, value in known.items():
        if isinstance(value, th.Tensor) and node.op == "call_function" and not all(user in known for user in node.users):
            program.register_buffer(f"constant_{node.name}", value.clone())
            with program.graph.inserting_before(node):
                node.replace_all_uses_with(program.graph.get_attr(f"constant_{node.name}"))
    program.graph.eliminate_dead_code()
    used = {node.target for node in program.graph.nodes if node.op == "get_attr"}
    for name in {name for name, _ in (*program.named_parameters(), *program.named_buffers())} - used:
        delattr(program, name)
    program.recompile()
    return program


def _solve_by_elimination(
    system: th.Tensor, right_side: th.Tensor, *, left: bool = True, check_errors: bool = False
) -> tuple[th.Tensor, ...]:
    """Gauss-Jordan with pivots, of operators that ONNX has; in place of PyTorch's ``_linalg_solve_ex``."""
    size = system.shape[-1]
    index = th.arange(size, device=system.device)
    rows = th.cat([system, right_side], dim=2)
    free, order = th.ones_like(system[:, :, 0], dtype=th.bool), []
    for column in range(size):
        values = rows[:, :, column]
        is_best = index == th.where(free, values.abs(), -1.0).argmax(dim=1, keepdim=True)
        chosen = is_best.to(system.dtype).unsqueeze(2)
        pivot = (chosen * rows).sum(dim=1, keepdim=True)
        rows = rows - (values.unsqueeze(2) - chosen) * (pivot / pivot[:, :, column : column + 1])
        free = free & ~is_best
        order.append(chosen.squeeze(2))
    solution = th.stack(order, dim=1) @ rows[:, :, size:]
    none = th.zeros_like(system[:, 0, 0], dtype=th.int32)
    return solution, system, none.unsqueeze(1).expand(-1, size), none


# Files -----------------------------------------------------------------------------------------------------------------


def _write_torchscript(
    program: GraphModule, acting: ExportedPolicy, arrays: Arrays, metadata: str, path: Path
) -> Callable[[Arrays], np.ndarray]:
    program = copy.deepcopy(program)
    for node in program.graph.nodes:
        # TorchScript chooses overloads for itself, and has no symbolic sizes
        if node.target is th.ops.aten.sym_size.int:
            node.target = th.ops.aten.size
        elif isinstance(node.target, th._ops.OpOverload):
            node.target = node.target.overloadpacket
    program.recompile()
    th.jit.save(th.jit.script(program), path, _extra_files={METADATA: metadata})
    loaded = th.jit.load(path)
    return lambda arrays: loaded(*map(th.as_tensor, arrays)).numpy()


def _exported_program(program: GraphModule, acting: ExportedPolicy, arrays: Arrays) -> th.export.ExportedProgram:
    batch = th.export.Dim("batch")
    shapes = tuple({0: batch} for _ in arrays)
    return th.export.export(program, tuple(map(th.as_tensor, arrays)), dynamic_shapes=shapes)


def _write_exported_program(
    program: GraphModule, acting: ExportedPolicy, arrays: Arrays, metadata: str, path: Path
) -> Callable[[Arrays], np.ndarray]:
    th.export.save(_exported_program(program, acting, arrays), path, extra_files={METADATA: metadata})
    loaded = th.export.load(path).module()
    return lambda arrays: loaded(*map(th.as_tensor, arrays)).detach().numpy()


def _write_onnx(
    program: GraphModule, acting: ExportedPolicy, arrays: Arrays, metadata: str, path: Path
) -> Callable[[Arrays], np.ndarray] | None:
    names, rule = acting.input_names, acting.policy.guidance_rule
    exported = th.onnx.export(
        _exported_program(program, acting, arrays),
        input_names=names,
        output_names=["action"],
        dynamo=True,
        external_data=False,
        verbose=False,
        # onnxscript 0.7's optimizer removes an operator that the denoiser's Jacobian needs
        optimize=not (acting.guided and rule.needs_jacobian),
    )
    assert exported is not None
    exported.model.metadata_props[METADATA] = metadata
    exported.save(path)
    importlib.import_module("onnx").checker.check_model(path)
    try:
        runtime = importlib.import_module("onnxruntime")
    except ImportError:
        return None
    options = runtime.SessionOptions()
    options.log_severity_level = 3  # errors
    session = runtime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    return lambda arrays: session.run(None, dict(zip(names, arrays, strict=True)))[0]


def _need_onnx() -> None:
    for module in ("onnx", "onnxscript"):
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise ImportError(f"{module} is needed to write .onnx: {EXPORT_HINT}, or write .pt or .pt2") from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what PyTorch's exporters say of themselves."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


_WRITERS: dict[str, Callable[..., Callable[[Arrays], np.ndarray] | None]] = {
    ".onnx": _write_onnx,
    ".pt": _write_torchscript,
    ".pt2": _write_exported_program,
}
