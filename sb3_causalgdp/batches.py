"""Where the batches of gradient steps come from: the environment's transitions, preloaded ones, or both."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_causalgdp.acceleration.device_replay import DeviceReplay
from sb3_causalgdp.counterfactual import CounterfactualReplay
from sb3_causalgdp.offline.replay import concatenate_samples, deal_rows, rows_of

Model = Any  # a CausalGDP, whose file imports this one


class Batches:
    """
    Draws what gradient steps learn from.

    :param model: The model, a ``CausalGDP``, whose replay buffers may be replaced
    """

    MOST_ROWS_PER_DRAW = 16_384

    def __init__(self, model: Model) -> None:
        self.model = model
        self.counterfactual = CounterfactualReplay(model)
        self._on_device: dict[str, tuple[ReplayBuffer, DeviceReplay | None]] = {}

    def up_to_actor_updates(self, gradient_steps: int, batch_size: int) -> Iterator[tuple[int, Any]]:
        """
        Batches are drawn many at a time.

        :param gradient_steps: How many are to be made
        :param batch_size: Transitions for each
        :return: The batches of the next gradient steps, one behind the other, and of how many: of those up to the next update
            of the actor
        """
        model = self.model
        most_at_once = 1 if model.policy.has_image_state else max(1, self.MOST_ROWS_PER_DRAW // batch_size)
        for first in range(0, gradient_steps, most_at_once):
            n_left = min(most_at_once, gradient_steps - first)
            sample = self.counterfactual.exchanged(self.sample(n_left * batch_size))
            drawn, begin = deal_rows(sample, n_left), 0
            while n_left > 0:
                n_steps = min(model.policy_delay - model._n_updates % model.policy_delay, n_left)
                end = begin + n_steps * batch_size
                yield n_steps, rows_of(drawn, slice(begin, end))
                begin, n_left = end, n_left - n_steps

    def sample(self, batch_size: int, one_step: bool = False) -> Any:
        """
        :param batch_size: Number of transitions
        :param one_step: Whether they are of single steps, where the replay buffer's returns are of several
        :return: A batch from the replay buffer, from the preloaded transitions, or from both
        """
        model = self.model
        assert model.replay_buffer is not None
        n_offline = model._n_offline(batch_size)
        parts = ((model.replay_buffer, batch_size - n_offline), (model.offline_buffer, n_offline))
        draw = self._draw_one_step if one_step else self._draw
        return concatenate_samples([draw(buffer, count) for buffer, count in parts if buffer is not None and count > 0])

    def _draw(self, replay_buffer: ReplayBuffer, batch_size: int) -> Any:
        normalizer = self.model._vec_normalize_env
        if normalizer is None:
            on_device = self.on_device(replay_buffer)
            if on_device is not None:
                return on_device.sample(batch_size)
        return replay_buffer.sample(batch_size, env=normalizer)

    def _draw_one_step(self, replay_buffer: ReplayBuffer, batch_size: int) -> Any:
        # The n-step buffer gives n-step rewards and observations, which are wrong for a one-step world model
        indices = np.random.randint(0, replay_buffer.size(), size=batch_size)
        return ReplayBuffer._get_samples(replay_buffer, indices, env=self.model._vec_normalize_env)

    def on_device(self, replay_buffer: ReplayBuffer) -> DeviceReplay | None:
        """
        :param replay_buffer: The model's replay buffer, or that of the preloaded transitions
        :return: Its copy on the device, None where it has none; made anew when it was replaced
        """
        name = "offline" if replay_buffer is self.model.offline_buffer else "online"
        known = self._on_device.get(name)
        if known is None or known[0] is not replay_buffer:
            covered = DeviceReplay.covers(replay_buffer, self.model.device)
            known = (replay_buffer, DeviceReplay(replay_buffer, self.model.device) if covered else None)
            self._on_device[name] = known
        return known[1]

    def forget_preloaded(self) -> None:
        """Copy the preloaded transitions anew: rows that are there already may have other rewards now."""
        self._on_device.pop("offline", None)
