"""In which order and which units a model's observations are."""

import warnings

from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecNormalize

from sb3_causalgdp.offline.observations import flattened_space, layout_name, same_layout
from sb3_causalgdp.offline.preload import (
    normalised_parts,
)
from sb3_causalgdp.offline.replay import SpacesEnv


class LaidOutAlgorithm(OffPolicyAlgorithm):
    """
    An algorithm that notices observations in another order of keys, or in other units, than those it was trained on.

    :param args: As for ``OffPolicyAlgorithm``
    :param kwargs: As for ``OffPolicyAlgorithm``
    """

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        # Which parts of the observations were normalised when the networks were trained last, None before they were
        self._trained_normalised: list[str] | None = None
        # The space of dictionaries or tuples that observations are flattened from: its order of keys is theirs
        self.observation_layout: spaces.Space | None = None

    def _checked_layout(self, env: GymEnv) -> spaces.Space | None:
        """What the observations of an environment are flattened from, by key; the model's own where that cannot be told."""
        own = self.observation_layout
        found = flattened_space(env, own)
        if same_layout(own, found):
            if own is not None and found is None and not isinstance(env, SpacesEnv):
                warnings.warn(
                    f"The model's observations are flattened in the order {layout_name(own)}, and it is not known whether "
                    "those of this environment are"
                )
            return own if found is None else found
        assert own is not None and found is not None
        raise ValueError(
            f"The model's observations are flattened in the order {layout_name(own)}, and this environment's in the order "
            f"{layout_name(found)}: give the environment that order of keys, or make the model with this environment"
        )

    def _layout_of(self, given: spaces.Space) -> spaces.Space | None:
        if self.observation_layout is None:
            self.observation_layout = flattened_space(self.env, given)
        return self.observation_layout

    def _check_layout(self, layout: spaces.Space | None, name: str) -> None:
        own = self.observation_layout
        if not same_layout(own, layout):
            assert own is not None and layout is not None
            raise ValueError(
                f"{name} holds observations flattened in the order {layout_name(layout)}, and the model's are in the order "
                f"{layout_name(own)}"
            )
        self.observation_layout = own or layout

    def _check_normalisation(self, normalizer: VecNormalize | None) -> None:
        before, now = self._trained_normalised, normalised_parts(normalizer)
        if before is None or before == now:
            return
        if not set(now) <= set(before):
            argument = f"norm_obs_keys={before}" if before else "norm_obs=False"
            raise ValueError(
                f"The policy was trained on {_normalised(before)}, and this VecNormalize would give it {_normalised(now)}: "
                f"pass {argument} to it, or give the model this environment before it is trained or pretrained"
            )
        warnings.warn(
            f"The policy was trained on {_normalised(before)}, and this environment gives it {_normalised(now)}: wrap it with "
            "VecNormalize.load(path, env) of the training's statistics"
        )


def _normalised(parts: list[str]) -> str:
    return f"observations with {parts} normalised" if parts else "raw observations"
