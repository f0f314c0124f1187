"""A policy that acts in one pass, trained to do what a guided chain of denoising does."""

from collections.abc import Sequence
from typing import Any

import torch as th
import torch.nn.functional as F

from sb3_causalgdp.prediction import act

Policy = Any  # a CausalGDPPolicy, whose file is above this one


def distil(
    teacher: Policy, observations: Sequence[Any], gradient_steps: int, batch_size: int = 256, learning_rate: float = 1e-3
) -> Policy:
    """
    Train a perceptron on the actions of a policy: those of the best candidate, steered. The mean absolute error is what is
    minimised, so that of two good actions it takes one, and not their mean.

    :param teacher: The policy, which stays as it is
    :param observations: Batches of observations as SB3 gives them to policies
    :param gradient_steps: How many are made; the learning rate falls to 0 over them
    :param batch_size: Observations for each
    :param learning_rate: Of Adam, at the start
    :return: A copy of the policy that acts by this perceptron
    """
    student = type(teacher)(**{**teacher._get_constructor_parameters(), "one_pass": True}).to(teacher.device)
    student.load_state_dict(teacher.state_dict(), strict=False)
    student.set_training_mode(False)
    was_training = teacher.training
    teacher.set_training_mode(False)
    with th.no_grad():
        features = th.cat([student.actor.features(batch) for batch in observations])
        actions = th.cat([act(teacher, batch, deterministic=True) for batch in observations])
    teacher.set_training_mode(was_training)
    network = student.actor.one_pass
    optimizer = th.optim.Adam(network.parameters(), lr=learning_rate)
    for step in range(gradient_steps):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * (1.0 - step / gradient_steps)
        rows = th.randint(len(features), (batch_size,), device=features.device)
        loss = F.l1_loss(network(features[rows]), actions[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    student.actor_target.one_pass.load_state_dict(network.state_dict())
    return student
