"""Denoisers by name and of one's own: what they are, what is refused, and what the causal graph lets a transformer see."""

import pytest
import torch as th
from small_models import SMALL
from torch import nn

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback
from sb3_causalgdp.diffusion import (
    DENOISERS,
    GuidanceRule,
    MLPDenoiser,
    NoiseSchedule,
    TransformerDenoiser,
    causal_attention,
    check_denoiser,
    make_denoiser,
    sample,
)
from sb3_causalgdp.losses import denoising_loss

ACTIONS, FEATURES, STEPS = 2, 3, 5


class Own(nn.Module):
    """A denoiser that is right; others below are wrong in one thing."""

    def __init__(self, action_dim, condition_dim, n_steps, net_arch, activation_fn):
        super().__init__()
        self.n_steps = n_steps
        self.network = nn.Sequential(nn.Linear(action_dim + condition_dim + 1, 16), nn.SiLU(), nn.Linear(16, action_dim))

    def forward(self, noisy_action, step, condition):
        time = th.as_tensor(step, dtype=noisy_action.dtype).expand(len(noisy_action)).unsqueeze(1) / self.n_steps
        return self.network(th.cat([noisy_action, condition, time], dim=1))


class WrongShape(Own):
    def forward(self, noisy_action, step, condition):
        return super().forward(noisy_action, step, condition)[:, :1]


class WrongType(Own):
    def forward(self, noisy_action, step, condition):
        return super().forward(noisy_action, step, condition).double()


class NoTensor(Own):
    def forward(self, noisy_action, step, condition):
        return super().forward(noisy_action, step, condition), None


class NotFinite(Own):
    def forward(self, noisy_action, step, condition):
        return super().forward(noisy_action, step, condition) / 0.0


class Detached(Own):
    def forward(self, noisy_action, step, condition):
        return super().forward(noisy_action, step, condition).detach()


class ActionDetached(Own):
    def forward(self, noisy_action, step, condition):
        return super().forward(noisy_action.detach(), step, condition)


class NoParameters(Own):
    def forward(self, noisy_action, step, condition):
        return 2.0 * noisy_action


class MixesRows(Own):
    def forward(self, noisy_action, step, condition):
        return super().forward(noisy_action - noisy_action.mean(dim=0), step, condition)


class IndexAlone(Own):
    def forward(self, noisy_action, step, condition):
        return super().forward(noisy_action, [0, 1, 2, 3, 4][step], condition)


class IgnoresTensors(Own):
    def forward(self, noisy_action, step, condition):
        return super().forward(noisy_action, 0 if isinstance(step, th.Tensor) else step, condition)


WRONG = {
    WrongShape: r"must return the shape \(3, 2\) of the noisy actions, got \(3, 1\)",
    WrongType: r"must return torch.float32, as its parameters are, got torch.float64",
    NoTensor: r"must return a tensor, got tuple",
    NotFinite: r"must return finite numbers, got -?(inf|nan)",
    Detached: r"must return a tensor with a gradient, got one without",
    ActionDetached: r"must carry a gradient to the noisy action, got none",
    NoParameters: r"must have parameters that lead to its output, got 4 of which none does",
    MixesRows: r"must return the same for a row alone and in a batch, got a difference of",
    IndexAlone: r"must accept noisy actions \(3, 2\), step torch.int64 of shape \(3,\)",
    IgnoresTensors: r"must return the same for a step and a tensor of it, got a difference of",
}


def make(denoiser, **kwargs):
    th.manual_seed(0)
    return make_denoiser(denoiser, ACTIONS, FEATURES, STEPS, [16, 16], nn.SiLU, kwargs or None)


@pytest.mark.parametrize("denoiser", [*DENOISERS, Own])
def test_each_denoiser_is_right_and_learns(denoiser):
    network = make(denoiser)
    check_denoiser(network, ACTIONS, FEATURES, STEPS)
    schedule, optimizer = NoiseSchedule("vp", STEPS), th.optim.Adam(network.parameters(), lr=3e-3)
    losses = []
    for _ in range(200):
        features = th.randn(64, FEATURES)
        loss = denoising_loss(network, schedule, features, th.tanh(features[:, :ACTIONS])).loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-20:]) < 0.6 * sum(losses[:20])
    assert all(parameter.grad is not None for parameter in network.parameters())


@pytest.mark.parametrize("denoiser", [*DENOISERS, Own])
def test_each_denoiser_is_guided_with_its_jacobian(denoiser):
    network, condition = make(denoiser), th.randn(4, FEATURES)
    noise = th.randn(STEPS, 4, ACTIONS)

    def pull(action):
        return 100.0 * (0.9 - action), 100.0 * th.eye(ACTIONS).expand(len(action), -1, -1)

    with th.no_grad():
        ends = sample(network, NoiseSchedule("vp", STEPS), condition, pull, GuidanceRule("posterior", "tweedie"), noise=noise)
        plain = sample(network, NoiseSchedule("vp", STEPS), condition, noise=noise)
    assert (ends - 0.9).abs().mean() < (plain - 0.9).abs().mean()


@pytest.mark.parametrize("denoiser", WRONG)
def test_what_is_wrong_with_a_denoiser_is_said(denoiser):
    with pytest.raises(ValueError, match=rf"denoiser {denoiser.__name__} {WRONG[denoiser]}"):
        make(denoiser)


def test_a_check_leaves_the_network_and_the_random_numbers_as_they_were():
    network = Own(ACTIONS, FEATURES, STEPS, [], nn.SiLU)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    state = th.get_rng_state()
    check_denoiser(network, ACTIONS, FEATURES, STEPS)
    assert network.training and th.equal(th.get_rng_state(), state)
    assert all(th.equal(value, before[name]) for name, value in network.state_dict().items())
    assert all(parameter.grad is None for parameter in network.parameters())


def test_names_and_arguments_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"Unknown denoiser 'unet'.*mlp.*residual_mlp.*transformer"):
        make("unet")
    with pytest.raises(ValueError, match=r"denoiser 'mlp' cannot be made from .*denoiser_kwargs=\{'width': 3\}"):
        make("mlp", width=3)
    with pytest.raises(ValueError, match=r"n_heads must be an integer that divides the width 16 of net_arch, got 3"):
        make("transformer", n_heads=3)
    for denoiser in ("residual_mlp", "transformer"):
        for net_arch in ([16, 8], []):
            with pytest.raises(ValueError, match="net_arch must hold an equal width for each block"):
                make_denoiser(denoiser, ACTIONS, FEATURES, STEPS, net_arch)


# The causal graph as attention ------------------------------------------------------------------------------------------

# s'_0 <- s_0, a_0; s'_1 <- s_0, a_1; s'_2 <- s_2; the reward reads s'_1
STATE_TO_STATE = th.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
ACTION_TO_STATE = th.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
STATE_TO_REWARD, ACTION_TO_REWARD = th.tensor([0.0, 1.0, 0.0]), th.zeros(2)
GRAPH = (STATE_TO_STATE, ACTION_TO_STATE, STATE_TO_REWARD, ACTION_TO_REWARD)


def test_an_action_looks_at_what_it_influences_and_what_its_effect_depends_on():
    seen = causal_attention(*GRAPH)
    # a_0 at s_0, a cause of s'_0 that it moves, and itself; a_1 at s_0, a cause of s'_1, at s_1, which it moves, and itself
    assert seen.tolist() == [[True, False, False, True, False], [True, True, False, False, True]]
    together = causal_attention(*GRAPH[:3], th.ones(2))
    # A reward that reads both actions, and s'_1
    assert together.tolist() == [[True, True, False, True, True], [True, True, False, True, True]]


def test_a_transformer_sees_along_the_graph_alone():
    denoiser = make("transformer")
    action, condition = th.randn(4, ACTIONS, requires_grad=True), th.randn(4, FEATURES, requires_grad=True)

    def reads():
        rows = []
        for component in range(ACTIONS):
            output = denoiser(action, 2, condition)[:, component].sum()
            gradients = th.autograd.grad(output, [condition, action])
            rows.append((th.cat(gradients, dim=1).abs().sum(dim=0) > 0.0).tolist())
        return rows

    assert reads() == [[True] * 5] * 2
    denoiser.set_graph(*GRAPH)
    assert reads() == causal_attention(*GRAPH).tolist()
    copied = make("transformer")
    copied.load_state_dict(denoiser.state_dict())
    assert th.equal(copied.attention, denoiser.attention)


def test_a_graph_of_other_variables_is_refused():
    denoiser = make("transformer")
    with pytest.raises(ValueError, match=r"action_to_state must have the denoiser's shape \(3, 2\), got \(2, 2\)"):
        denoiser.set_graph(th.ones(2, 2), th.ones(2, 2), th.ones(2), th.ones(2))


# In CausalGDP -----------------------------------------------------------------------------------------------------------


def learned(**policy_kwargs):
    arguments = {**SMALL, "policy_kwargs": {**SMALL["policy_kwargs"], **policy_kwargs}}
    return CausalGDP("MlpPolicy", "Pendulum-v1", **arguments).learn(
        100, callback=CausalWorldModelCallback(min_transitions=40, diagnostics_batch_size=8)
    )


def test_a_causal_transformer_gets_the_discovered_graph_and_keeps_it(tmp_path):
    model = learned(denoiser="transformer", denoiser_kwargs={"causal": True, "n_heads": 2})
    assert len(model.causal_graph_history) == 1
    graph = model.causal_graph()
    masks = (graph.state_to_state, graph.action_to_state, graph.state_to_reward, graph.action_to_reward)
    expected = causal_attention(*(th.as_tensor(mask, dtype=th.float32) for mask in masks)).float()
    for actor in (model.actor, model.actor_target):
        assert isinstance(actor.denoiser, TransformerDenoiser)
        assert th.equal(actor.denoiser.attention[3:4, :4], expected)
        assert th.equal(actor.denoiser.attention[:3, :3], th.eye(3))
    model.save(tmp_path / "model")
    loaded = CausalGDP.load(tmp_path / "model")
    assert th.equal(loaded.actor.denoiser.attention, model.actor.denoiser.attention)
    observation = model.observation_space.sample()
    assert (loaded.predict(observation, deterministic=True)[0] == model.predict(observation, deterministic=True)[0]).all()


def test_a_denoiser_of_ones_own_and_other_steps_survive_saving(tmp_path):
    model = learned(denoiser=Own, sampling_steps=3)
    model.save(tmp_path / "model")
    loaded = CausalGDP.load(tmp_path / "model", trusted=True)
    assert type(loaded.actor.denoiser) is Own and loaded.actor.sampling_steps == 3
    observation = model.observation_space.sample()
    assert (loaded.predict(observation, deterministic=True)[0] == model.predict(observation, deterministic=True)[0]).all()
    policy = type(model.policy)(**model.policy._get_constructor_parameters())
    assert type(policy.actor.denoiser) is Own and policy.actor.n_noises == 3


def test_what_is_wrong_with_ones_own_denoiser_is_said_before_training():
    with pytest.raises(ValueError, match="denoiser MixesRows must return the same for a row alone"):
        learned(denoiser=MixesRows)
    with pytest.raises(ValueError, match=r"denoiser must be one of \['mlp', 'residual_mlp', 'transformer'\] or a class"):
        learned(denoiser="unet")


def test_the_default_is_the_plain_network():
    assert type(make("mlp")) is MLPDenoiser


@pytest.mark.parametrize("name", DENOISERS)
@pytest.mark.parametrize("step", [0, 2, 4, 1.5, th.tensor([0, 3, 4]), th.tensor([0.0, 1.5, 3.25])])
def test_the_noise_follows_from_the_velocity_at_every_time(name, step):
    schedule = NoiseSchedule("cosine", 5)
    arguments = (2, 3, 5, [8, 8])
    plain, denoiser = make_denoiser(name, *arguments), make_denoiser(name, *arguments, alpha_bar=schedule.alpha_bar)
    denoiser.load_state_dict(plain.state_dict())
    action, condition = th.randn(3, 2), th.randn(3, 3)
    left = schedule.signal_left(step)
    # v = signal eps - noise a0, and a = signal a0 + noise eps
    expected = left.sqrt() * plain(action, step, condition) + (1.0 - left).sqrt() * action
    th.testing.assert_close(denoiser(action, step, condition), expected, rtol=1e-4, atol=1e-4)
