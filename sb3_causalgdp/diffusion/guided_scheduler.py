"""Guidance for a policy whose sampler is a scheduler of ``diffusers``, such as those of LeRobot and ``diffusion_policy``."""

from collections.abc import Callable
from numbers import Integral
from typing import Any, NamedTuple

import torch as th

from sb3_causalgdp.diffusion.guidance import Guidance, GuidanceRule, checked_answer

# Share of signal below which the model's Jacobian says nothing of what the clean action is
LEAST_SIGNAL = 1e-6
# Whose samples are what ``noise_level`` says, by the tests: of the others, some count noise otherwise
SUPPORTED = (
    "DDPMScheduler",
    "DDIMScheduler",
    "DEISMultistepScheduler",
    "DPMSolverMultistepScheduler",
    "EulerAncestralDiscreteScheduler",
    "EulerDiscreteScheduler",
    "FlowMatchEulerDiscreteScheduler",
    "FlowMatchHeunDiscreteScheduler",
    "HeunDiscreteScheduler",
    "KDPM2DiscreteScheduler",
    "LCMScheduler",
    "LMSDiscreteScheduler",
    "PNDMScheduler",
    "SASolverScheduler",
    "TCDScheduler",
    "UniPCMultistepScheduler",
)


class ActionUnits(NamedTuple):
    """
    From the actions of a policy's network to those of the guidance: ``action = scale * normalised + offset``.

    :param scale: A number, or shape ``(d,)``
    :param offset: A number, or shape ``(d,)``
    """

    scale: th.Tensor | float = 1.0
    offset: th.Tensor | float = 0.0

    @classmethod
    def from_min_max(cls, low: th.Tensor, high: th.Tensor) -> "ActionUnits":
        """
        LeRobot's normalisation ``MIN_MAX``, to [-1, 1].

        :param low: Smallest action of the dataset, shape ``(d,)``
        :param high: The largest, shape ``(d,)``
        :return: The way back
        """
        low, high = th.as_tensor(low), th.as_tensor(high)
        return cls((high - low) / 2.0, (high + low) / 2.0)

    @classmethod
    def from_mean_std(cls, mean: th.Tensor, std: th.Tensor) -> "ActionUnits":
        """
        LeRobot's normalisation ``MEAN_STD``.

        :param mean: Of the dataset, shape ``(d,)``
        :param std: Of the dataset, shape ``(d,)``
        :return: The way back
        """
        return cls(th.as_tensor(std), th.as_tensor(mean))

    @classmethod
    def from_linear_normalizer(cls, scale: th.Tensor, offset: th.Tensor) -> "ActionUnits":
        """
        ``LinearNormalizer`` of ``diffusion_policy``, ``normalizer["action"].params_dict``: ``normalised = scale * action +
        offset``.

        :param scale: Its scale, shape ``(d,)``
        :param offset: Its offset, shape ``(d,)``
        :return: The way back
        """
        scale, offset = th.as_tensor(scale), th.as_tensor(offset)
        return cls(1.0 / scale, -offset / scale)

    @classmethod
    def from_unnormalizer(cls, unnormalize: Callable[[th.Tensor], th.Tensor], n_actions: int) -> "ActionUnits":
        """
        Any function from the network's actions to the environment's that takes each component by itself, such as the
        postprocessor of a LeRobot policy, whatever its normalisation is. It is asked for four actions.

        :param unnormalize: From shape ``(batch, d)`` to the same shape
        :param n_actions: Number of action components d
        :return: The way back
        :raises ValueError: If it is not of the form ``scale * normalised + offset``
        """
        normalised = th.tensor([-1.0, 0.0, 0.5, 1.0])[:, None].expand(-1, n_actions)
        with th.no_grad():
            actions = unnormalize(normalised)
        offset, scale = actions[1], actions[3] - actions[1]
        # Of components near their offset, rounding is all that is left
        difference = (scale * normalised + offset - actions).abs()
        if bool((difference > 1e-3 * scale.abs() + 1e-5 * offset.abs()).any()) or bool((scale == 0.0).any()):
            raise ValueError(
                "unnormalize must be scale * action + offset, component by component, "
                f"got {actions.tolist()} for actions of -1, 0, 0.5 and 1"
            )
        return cls(scale, offset)


class NoiseLevel(NamedTuple):
    """
    What a scheduler's sample is: ``signal * clean + spread * noise``.

    :param signal: Factor of the clean action
    :param spread: Standard deviation of the noise
    """

    signal: float
    spread: float

    @property
    def norm(self) -> float:
        """What a sample is divided by to be one of a schedule that preserves the variance."""
        return (self.signal**2 + self.spread**2) ** 0.5

    @property
    def alpha_bar(self) -> float:
        """Share of signal left."""
        return (self.signal / self.norm) ** 2


class GuidedScheduler:
    """
    A scheduler of ``diffusers`` whose ``step`` is steered by a guidance. All else is the scheduler's own.

    For a sample ``x = signal * a + spread * eps`` the guidance adds ``G = grad_x log p(y | x)`` to the score, which moves the
    clean estimate by ``spread^2 / signal * G``, the noise by ``-spread * G``, and the velocity ``eps - a`` of flow matching,
    where ``signal = 1 - spread``, by ``-spread / (1 - spread) * G``. In ``step``, what the network says is turned into the
    clean estimate, moved, and turned back, so that the scheduler's own method, clipping, history and noise stay as they are.

    :param scheduler: One of ``diffusers`` that is in ``SUPPORTED``, such as DDPM, DDIM, DPM-Solver, Euler and flow-matching
        Euler; or one of your own that counts noise like them
    :param guidance: Log density over actions of shape ``(batch, d)``, in the environment's units, None for none; it may be
        replaced before each chain, ``scheduler.guidance = ...``
    :param rule: How the guidance enters a step, :class:`GuidanceRule` with the covariance ``unit_gaussian`` if None
    :param model: The network, bound to its condition: ``model(sample, timestep)``, the sample scaled as the scheduler's
        ``scale_model_input`` does it; needed by the covariances ``tweedie`` and ``isotropic``, which take its Jacobian; as
        ``guidance``, it may be replaced before each chain
    :param units: Units of the network's actions
    :param position: The action of a chunk that the guidance is about, counted along the horizon; None for the whole chunk,
        which the guidance then gets as one row of ``horizon * d`` components
    :param clip: Bound of the network's clean actions at which the guidance is evaluated, None for no bound
    :raises ValueError: If the rule has more scales than one, or a bound is not positive
    :raises TypeError: If an argument is of another kind, or the scheduler one of ``diffusers`` that is not supported
    """

    def __init__(
        self,
        scheduler: Any,
        guidance: Guidance | None = None,
        rule: GuidanceRule | None = None,
        *,
        model: Callable[[th.Tensor, Any], th.Tensor] | None = None,
        units: ActionUnits | None = None,
        position: int | None = None,
        clip: float | None = 1.0,
    ) -> None:
        _check_scheduler(scheduler)
        functions: dict[str, Any] = {"guidance": guidance, "model": model}
        for what, value in functions.items():
            if value is not None and not callable(value):
                raise TypeError(f"{what} must be a function or None, got {value!r}")
        objects: dict[str, tuple[Any, type]] = {"rule": (rule, GuidanceRule), "units": (units, ActionUnits)}
        for what, (value, kind) in objects.items():
            if value is not None and not isinstance(value, kind):
                raise TypeError(f"{what} must be of the class {kind.__name__} or None, got {value!r}")
        if position is not None and (isinstance(position, bool) or not isinstance(position, Integral)):
            raise TypeError(f"position must be an integer or None, got {position!r}")
        if clip is not None and not (isinstance(clip, int | float) and clip > 0.0):
            raise ValueError(f"clip must be a positive number or None, got {clip!r}")
        self.scheduler = scheduler
        self.guidance = guidance
        self.rule = GuidanceRule() if rule is None else rule
        self.model = model
        self.units = ActionUnits() if units is None else units
        self.position = position
        self.clip = clip
        if len(self.rule.scales) != 1:
            raise ValueError(f"guidance_scale must be one number here, got {len(self.rule.scales)} values")

    def __getattr__(self, name: str) -> Any:
        # Not found on this object, so the scheduler's; a copy that is not whole yet has none
        if name == "scheduler":
            raise AttributeError(name)
        return getattr(self.scheduler, name)

    def __len__(self) -> int:
        return len(self.scheduler)

    def step(self, model_output: th.Tensor, timestep: Any, sample: th.Tensor, *args: Any, **kwargs: Any) -> Any:
        """
        The scheduler's step, guided.

        :param model_output: What the network predicts, shape ``(batch, d)`` or ``(batch, horizon, d)``
        :param timestep: The scheduler's timestep
        :param sample: The noisy actions, as the scheduler has them, of the same shape
        :param args: Further arguments of the scheduler
        :param kwargs: Further arguments of the scheduler
        :return: What the scheduler returns
        """
        if self.guidance is not None:
            level = self.noise_level(timestep)
            clean = self.clean_estimate(model_output, sample, level) + self.shift(model_output, timestep, sample, level)
            model_output = self._prediction(clean, sample, level).to(model_output.dtype)
        return self.scheduler.step(model_output, timestep, sample, *args, **kwargs)

    def noise_level(self, timestep: Any) -> NoiseLevel:
        """
        :param timestep: The scheduler's timestep
        :return: What its sample is made of there
        """
        scheduler = self.scheduler
        sigmas = getattr(scheduler, "sigmas", None)
        if sigmas is None:
            alpha_bar = float(scheduler.alphas_cumprod[int(timestep)])
            return NoiseLevel(alpha_bar**0.5, (1.0 - alpha_bar) ** 0.5)
        if scheduler.step_index is None:
            scheduler._init_step_index(timestep)
        sigma = float(sigmas[scheduler.step_index])
        if self.is_flow:
            return NoiseLevel(1.0 - sigma, sigma)
        if hasattr(scheduler, "_sigma_to_alpha_sigma_t"):
            signal = (1.0 + sigma**2) ** -0.5
            return NoiseLevel(signal, sigma * signal)
        return NoiseLevel(1.0, sigma)

    @property
    def is_flow(self) -> bool:
        """Whether the scheduler's noise goes to the action along a straight line, as in flow matching."""
        config = self.scheduler.config
        return not hasattr(self.scheduler, "alphas_cumprod") or bool(config.get("use_flow_sigmas", False))

    @property
    def prediction_type(self) -> str:
        """What the network predicts: ``epsilon``, ``sample``, ``v_prediction`` or ``flow_prediction``."""
        return self.scheduler.config.get("prediction_type", "flow_prediction")

    def clean_estimate(self, model_output: th.Tensor, sample: th.Tensor, level: NoiseLevel) -> th.Tensor:
        """
        :param model_output: What the network predicts
        :param sample: The noisy actions
        :param level: What they are made of
        :return: Its estimate of the clean actions, of the same shape
        :raises ValueError: If the scheduler has another prediction type
        """
        signal, spread = level
        if self.prediction_type == "epsilon":
            return (sample - spread * model_output) / signal
        if self.prediction_type == "sample":
            return model_output
        if self.prediction_type == "v_prediction":
            return (signal * sample / level.norm - spread * model_output) / level.norm
        if self.prediction_type == "flow_prediction":
            return sample - spread * model_output
        raise ValueError(
            "prediction_type must be 'epsilon', 'sample', 'v_prediction' or 'flow_prediction', "
            f"got {self.prediction_type!r} of {type(self.scheduler).__name__}"
        )

    def _prediction(self, clean: th.Tensor, sample: th.Tensor, level: NoiseLevel) -> th.Tensor:
        """The inverse of :meth:`clean_estimate`."""
        signal, spread = level
        if self.prediction_type == "epsilon":
            return (sample - signal * clean) / spread
        if self.prediction_type == "sample":
            return clean
        if self.prediction_type == "v_prediction":
            return (signal * sample / level.norm - level.norm * clean) / spread
        return (sample - clean) / spread

    @th.no_grad()
    def shift(self, model_output: th.Tensor, timestep: Any, sample: th.Tensor, level: NoiseLevel) -> th.Tensor:
        """
        How far the guidance moves the clean estimate.

        :param model_output: What the network predicts
        :param timestep: The scheduler's timestep
        :param sample: The noisy actions
        :param level: What they are made of
        :return: The shift in the network's units, of the sample's shape
        """
        assert self.guidance is not None
        shape = sample.shape
        clean = self.clean_estimate(model_output, sample, level)
        gradient, curvature = self._local_model(clean if self.clip is None else clean.clamp(-self.clip, self.clip))
        share = th.full((1, 1), max(level.alpha_bar, 1e-12), dtype=gradient.dtype, device=gradient.device)
        strength = self.rule.scales[0] * (1.0 - share) / share.sqrt()
        # At no signal at all a network says what it likes, and what it says does not depend on the sample
        if self.rule.needs_jacobian and level.alpha_bar > LEAST_SIGNAL:
            gradient, curvature = self._of_all_actions(gradient, curvature, shape)
            jacobian = level.norm * self._jacobian(timestep, sample, level)
            return (strength * self.rule(gradient, curvature, share, jacobian)).reshape(shape)
        rule = GuidanceRule("posterior", "unit_gaussian") if self.rule.needs_jacobian else self.rule
        # Without the network's Jacobian, the guided action is the only one that moves
        shift = strength * rule(gradient, curvature, share)
        if not self._is_about_one(shape):
            return shift.reshape(shape)
        whole = th.zeros(shape, dtype=shift.dtype, device=shift.device)
        whole[:, self.position] = shift
        return whole

    def _is_about_one(self, shape: th.Size) -> bool:
        """Whether the guidance is about one action of a chunk."""
        return len(shape) == 3 and self.position is not None

    def _local_model(self, clean: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Gradient and curvature of the guidance by what it is about, in the network's units."""
        assert self.guidance is not None
        scale, offset = (th.as_tensor(value, dtype=clean.dtype, device=clean.device) for value in self.units)
        self._check_shape(clean.shape, scale)
        factor, actions = scale.expand(clean.shape[1:]), scale * clean + offset
        if self._is_about_one(clean.shape):
            factor, actions = factor[self.position], actions[:, self.position]
        rows = actions.flatten(1)
        gradient, curvature = checked_answer(self.guidance(rows), rows)
        if not bool(gradient.isfinite().all() & curvature.isfinite().all()):
            whose = "guidance must give" if bool(rows.isfinite().all()) else "The network must predict"
            raise ValueError(f"{whose} finite numbers, got NaN or infinite ones")
        factor = factor.flatten()
        return gradient * factor, curvature * factor[:, None] * factor

    def _check_shape(self, shape: th.Size, scale: th.Tensor) -> None:
        width = shape[-1]
        if scale.ndim > 0 and scale.shape[-1] not in (1, width):
            raise ValueError(f"units must be those of {width} action components, as samples have, got {scale.shape[-1]}")
        if self._is_about_one(shape) and not -shape[1] <= int(self.position or 0) < shape[1]:
            raise ValueError(f"position must be an index of a chunk of {shape[1]} actions, got {self.position}")

    def _of_all_actions(self, gradient: th.Tensor, curvature: th.Tensor, shape: th.Size) -> tuple[th.Tensor, th.Tensor]:
        """The same by all of a chunk, ``horizon * d`` components, of which most are 0 where it is about one action."""
        if not self._is_about_one(shape):
            return gradient, curvature
        batch, horizon, width = shape
        whole_gradient, whole_curvature = gradient.new_zeros(shape), curvature.new_zeros(batch, horizon, width, horizon, width)
        whole_gradient[:, self.position] = gradient
        whole_curvature[:, self.position, :, self.position] = curvature
        return whole_gradient.flatten(1), whole_curvature.reshape(batch, horizon * width, horizon * width)

    def _jacobian(self, timestep: Any, sample: th.Tensor, level: NoiseLevel) -> th.Tensor:
        """Of the clean estimate by the sample, shape ``(batch, m, m)``."""
        model, shape = self.model, sample.shape
        if model is None:
            raise ValueError(
                f"guidance_covariance={self.rule.covariance!r} needs the network's Jacobian: give model, or 'unit_gaussian'"
            )
        n_components = sample[0].numel()

        def scaled(noisy: th.Tensor) -> th.Tensor:
            # Flow matching has no scaling, and no method of that name
            scale = getattr(self.scheduler, "scale_model_input", None)
            return noisy if scale is None else scale(noisy, timestep)

        def clean(noisy: th.Tensor) -> th.Tensor:
            return self.clean_estimate(model(scaled(noisy), timestep), noisy, level).flatten(1)

        def column(tangent: th.Tensor) -> th.Tensor:
            tangents = tangent.reshape(shape[1:]).expand(shape)
            return th.func.jvp(clean, (sample,), (tangents,))[1]

        identity = th.eye(n_components, dtype=sample.dtype, device=sample.device)
        return th.func.vmap(column)(identity).permute(1, 2, 0)


def _check_scheduler(scheduler: Any) -> None:
    if isinstance(scheduler, GuidedScheduler):
        raise TypeError("scheduler is guided already: set its guidance, or wrap its scheduler.scheduler")
    if isinstance(scheduler, type) or not callable(getattr(scheduler, "step", None)) or not hasattr(scheduler, "config"):
        raise TypeError(f"scheduler must be an object of diffusers, like DDIMScheduler(), got {scheduler!r}")
    classes = type(scheduler).__mro__
    if classes[0].__module__.startswith("diffusers.") and not any(one.__name__ in SUPPORTED for one in classes):
        raise TypeError(
            f"scheduler must be one of {list(SUPPORTED)}, which are known to be guided right, got {classes[0].__name__}"
        )
