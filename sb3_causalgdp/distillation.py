"""A policy that acts in one pass, trained to do what a guided chain of denoising does."""

from collections.abc import Callable, Sequence
from typing import Any

import torch as th
import torch.nn.functional as F
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_causalgdp.prediction import act

Policy = Any  # a CausalGDPPolicy, whose file is above this one


def distil(
    teacher: Policy,
    observations: Sequence[Any],
    gradient_steps: int,
    batch_size: int = 256,
    learning_rate: float = 1e-3,
    visit: Callable[[Policy], Sequence[Any]] | None = None,
    n_rounds: int = 0,
) -> Policy:
    """
    Train a perceptron on the actions of a policy: those of the best candidate, steered. The mean absolute error is what is
    minimised, so that of two good actions it takes one, and not their mean.

    :param teacher: The policy, which stays as it is
    :param observations: Batches of observations as SB3 gives them to policies
    :param gradient_steps: How many are made; the learning rate falls to 0 over them
    :param batch_size: Observations for each
    :param learning_rate: Of Adam, at the start
    :param visit: Batches of observations that a policy gets to by its own actions
    :param n_rounds: How often the perceptron learns what the teacher does there, too, with half as many gradient steps
        (DAgger, Ross et al., 2011, https://arxiv.org/abs/1011.0686)
    :return: A copy of the policy that acts by this perceptron
    """
    # Features are those of the network that is trained
    one_pass = {"one_pass": True, "causal_abstraction": False, "use_ema": False}
    student = type(teacher)(**{**teacher._get_constructor_parameters(), **one_pass}).to(teacher.device)
    # Without the gates, what is hidden from the teacher is not shown again
    own = {name: value for name, value in teacher.state_dict().items() if name not in ("state_gate", "action_gate")}
    student.load_state_dict(own, strict=False)
    student.set_training_mode(False)
    network = student.actor.one_pass
    examples = _examples(teacher, student, observations)
    _imitate(network, *examples, gradient_steps, batch_size, learning_rate)
    for _ in range(n_rounds if visit is not None else 0):
        assert visit is not None
        more = _examples(teacher, student, visit(student))
        examples = th.cat([examples[0], more[0]]), th.cat([examples[1], more[1]])
        _imitate(network, *examples, max(1, gradient_steps // 2), batch_size, learning_rate)
    student.actor_target.one_pass.load_state_dict(network.state_dict())
    return student


def _examples(teacher: Policy, student: Policy, observations: Sequence[Any]) -> tuple[th.Tensor, th.Tensor]:
    """What the perceptron sees of the observations, and what the teacher does there."""
    was_training = teacher.training
    teacher.set_training_mode(False)
    with th.no_grad():
        features = th.cat([student.actor.features(batch) for batch in observations])
        actions = th.cat([act(teacher, batch, deterministic=True) for batch in observations])
    teacher.set_training_mode(was_training)
    return features, actions


def _imitate(
    network: th.nn.Module, features: th.Tensor, actions: th.Tensor, gradient_steps: int, batch_size: int, learning_rate: float
) -> None:
    optimizer = th.optim.Adam(network.parameters(), lr=learning_rate)
    for step in range(gradient_steps):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * (1.0 - step / gradient_steps)
        rows = th.randint(len(features), (batch_size,), device=features.device)
        loss = F.l1_loss(network(features[rows]), actions[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def visited(policy: Policy, env: VecEnv, n_observations: int, normalizer: VecNormalize | None = None) -> list[Any]:
    """
    :param policy: Acts without noise
    :param env: Where; it goes on from its reset
    :param n_observations: How many are wanted, at least
    :param normalizer: What observations pass before the policy sees them; its statistics stay as they are
    :return: Batches of observations as SB3 gives them to policies, of one time each
    """
    batches, observation = [], env.reset()
    for _ in range(-(-n_observations // env.num_envs)):
        seen = observation if normalizer is None else normalizer.normalize_obs(observation)  # type: ignore[arg-type]
        batches.append(policy.obs_to_tensor(seen)[0])
        action, _ = policy.predict(seen, deterministic=True)
        observation = env.step(action)[0]
    return batches
