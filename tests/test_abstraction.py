import io

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from goal_env import GoalEnv
from gymnasium import spaces
from small_models import SMALL
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.acceleration import switch
from sb3_causalgdp.callbacks import CausalWorldModelCallback
from sb3_causalgdp.causal import CausalGraph
from sb3_causalgdp.networks import q_values
from sb3_causalgdp.policies import CausalGDPPolicy

N_STATES, N_ACTIONS = 5, 3
HIDDEN_STATES, HIDDEN_ACTIONS = [1, 3], [2]


class Cart(gym.Env):
    """A velocity that the first action pushes; the other observations are noise, and so is what the other actions do."""

    observation_space = spaces.Box(-np.inf, np.inf, (N_STATES,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (N_ACTIONS,), np.float32)

    def __init__(self, cost_only=False):
        self.cost_only = cost_only

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.velocity, self.n_steps = 0.0, 0
        return self._observation(), {}

    def step(self, action):
        self.n_steps += 1
        self.velocity = 0.8 * self.velocity + float(action[0]) + 0.1 * self.np_random.normal()
        reward = -(float(action[0]) ** 2) if self.cost_only else self.velocity
        return self._observation(), reward, False, self.n_steps == 20, {}

    def _observation(self):
        return np.array([self.velocity, *self.np_random.normal(size=N_STATES - 1)])


class DictCart(gym.ObservationWrapper):
    def __init__(self, env):
        super().__init__(env)
        box = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.observation_space = spaces.Dict({"b": box, "a": spaces.Box(-np.inf, np.inf, (3,), np.float64)})

    def observation(self, observation):
        return {"b": observation[:2], "a": observation[2:]}


ENVIRONMENTS = {
    "box": Cart,
    "dict": lambda: DictCart(Cart()),
    "stack": lambda: VecFrameStack(DummyVecEnv([Cart]), 2),
    "normalized": lambda: VecNormalize(DummyVecEnv([Cart])),
}


def make(env="box", abstraction=True, **arguments):
    made = ENVIRONMENTS[env]()
    policy = "MultiInputPolicy" if env == "dict" else "MlpPolicy"
    kwargs = {**SMALL, "exploration_noise": 0.2, **arguments}
    kwargs["policy_kwargs"] = {**SMALL["policy_kwargs"], **arguments.get("policy_kwargs", {})}
    return CausalGDP(policy, made, causal_abstraction=abstraction, **kwargs)


def flags(size, hidden):
    shown = th.ones(size, dtype=th.bool)
    shown[hidden] = False
    return shown


def hide(model, states=HIDDEN_STATES, actions=HIDDEN_ACTIONS):
    model.policy.show(flags(len(model.policy.state_gate), states), flags(N_ACTIONS, actions))


def parameters_of(model):
    return {name: value.clone() for name, value in model.policy.state_dict().items() if "gate" not in name}


@pytest.fixture(scope="module")
def trained():
    """Long enough for a graph, with nothing hidden yet."""
    model = make(abstraction={"keep_open": [f"obs[{i}]" for i in range(N_STATES)]}).learn(240)
    hide(model)
    return model


# Nothing is irrelevant ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", [{}, {"actor_update": "chain", "policy_kwargs": {"critic_normalization": "layer"}}])
def test_where_nothing_is_hidden_all_numbers_are_the_same(arguments):
    names = [*(f"obs[{i}]" for i in range(N_STATES)), *(f"action[{i}]" for i in range(N_ACTIONS))]
    plain, gated = (make(abstraction=one, **arguments).learn(300) for one in (False, {"keep_open": names}))
    assert gated.policy.is_guided and gated.relevance_gate.states.all()
    expected, found = parameters_of(plain), parameters_of(gated)
    assert expected.keys() == found.keys()
    assert all(th.equal(expected[name], found[name]) for name in expected)
    observations = np.random.default_rng(0).normal(size=(100, N_STATES))
    for rows in (observations[:1], observations):
        actions = [model.predict(rows, deterministic=True)[0] for model in (plain, gated)]
        np.testing.assert_array_equal(*actions)


def test_nothing_can_be_hidden_unless_that_was_asked_for():
    model = make(abstraction=False)
    assert model.relevance_gate is None and not any("gate" in name for name in model.policy.state_dict())
    with pytest.raises(ValueError, match="causal_abstraction must be True"):
        model.policy.show(flags(N_STATES, [0]), flags(N_ACTIONS, []))


# What is hidden ----------------------------------------------------------------------------------------------------------


def changed_rows(model, index):
    """Observations, and the same with another value of one variable."""
    rng = np.random.default_rng(0)
    space = model.observation_space
    n_states = len(model.policy.state_gate)
    rows = rng.normal(size=(4, n_states)).astype(np.float32)
    others = rows.copy()
    others[:, index] += 2.0
    if not isinstance(space, spaces.Dict):
        return rows, others
    sizes = np.cumsum(model.policy.leaf_sizes)[:-1]
    return [dict(zip(space.spaces, np.split(values, sizes, axis=1), strict=True)) for values in (rows, others)]


@pytest.mark.parametrize("accelerated", [True, False])
@pytest.mark.parametrize("env", ["box", "dict", "stack", "normalized"])
@pytest.mark.parametrize("normalize", [True, False])
def test_actor_and_critics_are_blind_to_what_is_hidden(env, normalize, accelerated, monkeypatch):
    model = make(env, policy_kwargs={"normalize_observations": normalize, "critic_normalization": "layer"})
    monkeypatch.setattr(switch, "is_on", lambda: accelerated)
    policy = model.policy
    hide(model)
    policy.set_training_mode(False)
    for index in range(len(policy.state_gate)):
        rows, others = changed_rows(model, index)
        actions = [model.predict(one, deterministic=True)[0] for one in (rows, others)]
        inputs = [policy.obs_to_tensor(one)[0] for one in (rows, others)]
        values = [critic(one, th.zeros(4, N_ACTIONS))[0] for critic in (policy.critic, policy.critic_target) for one in inputs]
        features = [actor.features(one) for actor in (policy.actor, policy.actor_target) for one in inputs]
        hidden = index in HIDDEN_STATES
        assert np.array_equal(*actions) == hidden, index
        for first, second in (values[:2], values[2:], features[:2], features[2:]):
            assert th.equal(first, second) == hidden, index


def test_hidden_stays_hidden_while_networks_are_trained(trained):
    model = trained
    model.train(6, 8)
    # Without the guidance, which is by the world model, that sees everything
    assert th.equal(*(model.actor(th.as_tensor(one), deterministic=True) for one in changed_rows(model, 1)))
    assert not th.equal(*(model.actor(th.as_tensor(one), deterministic=True) for one in changed_rows(model, 0)))
    state = th.randn(4, N_STATES)
    gradient = model.policy.value_gradient(state, th.zeros(4, N_ACTIONS))
    assert not gradient[:, HIDDEN_STATES].any() and gradient[:, 0].all()


def test_the_fast_way_to_act_is_blind_to_the_same(trained, monkeypatch):
    assert trained.policy.is_guided
    rows, _ = changed_rows(trained, 0)
    fast, _ = trained.predict(rows, deterministic=True)
    monkeypatch.setattr(switch, "is_on", lambda: False)
    trained.policy._acting = None
    slow, _ = trained.predict(rows, deterministic=True)
    np.testing.assert_allclose(fast, slow, atol=2e-4)
    assert not fast[:, HIDDEN_ACTIONS].any() and fast[:, 0].all()


# Actions -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sampler", ["ddpm", "ddim"])
@pytest.mark.parametrize("prediction_type", ["velocity", "noise"])
def test_hidden_actions_are_neutral_plus_exploration_noise(sampler, prediction_type):
    model = make(sampler=sampler, policy_kwargs={"prediction_type": prediction_type})
    hide(model)
    rows = np.zeros((2000, N_STATES))
    quiet, _ = model.predict(rows, deterministic=True)
    noisy, _ = model.predict(rows)
    assert not quiet[:, 2].any() and quiet[:, :2].all()
    assert np.std(noisy[:, 2]) == pytest.approx(0.2, rel=0.1) and abs(noisy[:, 2].mean()) < 0.02


def test_the_neutral_action_is_the_middle_of_its_range():
    class Shifted(Cart):
        action_space = spaces.Box(np.array([-1.0, -1.0, 2.0]), np.array([1.0, 1.0, 6.0]), dtype=np.float32)

    model = CausalGDP("MlpPolicy", Shifted(), causal_abstraction=True, **SMALL)
    hide(model)
    action, _ = model.predict(np.zeros(N_STATES), deterministic=True)
    assert action[2] == pytest.approx(4.0)


@pytest.mark.parametrize("normalization", ["batch", "layer"])
@pytest.mark.parametrize("actor_update", ["one_step", "chain"])
def test_hidden_actions_are_in_no_target_loss_or_value(normalization, actor_update):
    model = make(actor_update=actor_update, policy_kwargs={"critic_normalization": normalization}, n_steps=1).learn(40)
    hide(model)
    updates, policy = model._updates, model.policy
    data = updates.batches.sample(8)
    other = data._replace(actions=data.actions * th.tensor([1.0, 1.0, -1.0]))
    assert not th.equal(data.actions, other.actions)
    results = []
    for batch in (data, other):
        th.manual_seed(0)
        next_actions, target = updates.bootstrap(batch)
        assert not next_actions[:, 2].any() and next_actions[:, :2].any()
        _, loss, by_critic = updates.critic_gradients(batch, target)
        losses, by_actor = updates.actor_gradients(batch, next_actions, 0, False)
        results.append([loss, *losses.values(), *by_critic, *by_actor])
    assert all(th.equal(first, second) for first, second in zip(*results, strict=True))
    last = policy.actor.denoiser.network[-1]
    index = [id(parameter) for parameter in policy.actor.parameters()].index(id(last.weight))
    assert not by_actor[index][2].any() and by_actor[index][:2].any()
    features = policy.critic.extract_features(data.observations, policy.critic.features_extractor)
    for way in (lambda a: policy.critic(data.observations, a), lambda a: q_values(policy.critic, features, a)):
        assert th.equal(way(data.actions)[0], way(other.actions)[0])


def test_losses_are_means_over_the_actions_that_are_modelled():
    model = make()
    model.learn(40)
    data = model._updates.batches.sample(8)
    with th.no_grad():
        denoiser = model.actor.denoiser
        for layer in (denoiser.input_layer, denoiser.network[-1]):
            layer.weight.zero_()
            layer.bias.zero_()

    def loss():
        th.manual_seed(0)
        return model._updates.actor_gradients(data, data.actions, climbed=0, guided=False)[0]["denoising_loss"].item()

    of_all, of_each = loss(), []
    for index in range(N_ACTIONS):
        hide(model, [], [other for other in range(N_ACTIONS) if other != index])
        of_each.append(loss())
    assert min(of_each) > 0.0 and of_all == pytest.approx(np.mean(of_each))
    hide(model, [], [0, 1, 2])
    assert loss() == 0.0


# Shown again ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("normalization", ["batch", "layer", None])
@pytest.mark.parametrize("normalize", [True, False])
def test_what_is_shown_again_makes_no_jump(normalization, normalize):
    kwargs = {"critic_normalization": normalization, "normalize_observations": normalize}
    model = make(policy_kwargs=kwargs, abstraction={"keep_open": ["obs[1]"]}).learn(40)
    hide(model)
    policy = model.policy
    for _ in range(40):
        model.train(8, 8)
    rows, others = changed_rows(model, 1)
    others_of_actions = th.rand(4, N_ACTIONS) * 2 - 1

    def outputs():
        policy.set_training_mode(False)
        found = []
        for observation in (rows, others):
            tensor = policy.obs_to_tensor(observation)[0]
            found += [*policy.critic(tensor, others_of_actions), *policy.critic_target(tensor, others_of_actions)]
            found.append(policy.actor_target(tensor, deterministic=True))
            found.append(th.as_tensor(policy.predict(observation, deterministic=True)[0]))
        return th.cat([values.detach().flatten().double() for values in found])

    before = outputs()
    hide(model, [])
    th.testing.assert_close(outputs(), before, atol=1e-4, rtol=1e-4)
    for optimizer, first_layer, column in columns_of(policy, 1):
        assert not first_layer.weight[:, column].any()
        state = optimizer.state[first_layer.weight]
        assert not state["exp_avg"][:, column].any()
        assert state["exp_avg_sq"][:, column].mean() > 0.1 * state["exp_avg_sq"].mean()
    if normalization == "batch":
        # A batch normalisation that still thought it constant would magnify it thirtyfold
        expected = 1.0 if normalize else policy.world_model.state_std[1].item() ** 2
        assert all(network[0].running_var[1].item() == pytest.approx(expected) for network in policy.critic.q_networks)
    model.train(30, 8)
    assert all(first_layer.weight[:, column].any() for _, first_layer, column in columns_of(policy, 1))
    assert not th.equal(outputs(), before)


def columns_of(policy, index):
    layer = policy.actor.denoiser.input_layer
    yield policy.actor.optimizer, layer, layer.in_features - N_STATES + index
    for network in policy.critic.q_networks:
        yield policy.critic.optimizer, next(one for one in network if isinstance(one, th.nn.Linear)), index


def test_an_action_that_is_shown_again_is_learned():
    model = make().learn(60)
    hide(model)
    model.train(20, 8)
    last = model.policy.actor.denoiser.network[-1]
    assert not last.weight[2].any() and not last.bias[2].any()
    hide(model, [], [])
    model.train(20, 8)
    assert last.weight[2].any()
    assert model.predict(np.zeros(N_STATES), deterministic=True)[0][2] != 0.0


# The world model ------------------------------------------------------------------------------------------------------------


class WideCart(gym.ObservationWrapper):
    """With 20 further noises."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Box(-np.inf, np.inf, (N_STATES + 20,), np.float64)

    def observation(self, observation):
        return np.array([*observation, *self.np_random.normal(size=20)])


ENVIRONMENTS["wide"] = lambda: WideCart(Cart())


def hide_noises(model):
    hide(model, list(range(N_STATES, N_STATES + 20)), [])


def test_next_values_of_hidden_states_cost_nothing_and_go_on_when_they_are_shown_again():
    model = make("wide").learn(60)
    world_model = model.world_model
    hide_noises(model)
    modelled = world_model.modelled_states
    assert modelled.tolist() == [True] * 8 + [False] * 17  # a multiple of 8
    output_weight = world_model.transition.output_weight
    # What is left of the optimizer's momentum is over soon
    model.train(100, 8)
    before = output_weight.clone()
    model.train(20, 8)
    moved = (output_weight - before).abs().amax(dim=1)
    assert moved[modelled].min() > 1e-4 and moved[~modelled].max() < 1e-6
    hide(model, [], [])
    assert world_model.modelled_states.all()
    squares = model.world_model.optimizer.state[output_weight]["exp_avg_sq"]
    assert squares[~modelled].min() > 0.1 * squares[modelled].mean()
    model.train(20, 8)
    assert (output_weight - before).abs().amax(dim=1)[~modelled].min() > 1e-4


@pytest.mark.parametrize("target", ["return", "reward"])
def test_guidance_of_what_is_shown_is_the_same_in_numpy_and_in_torch(target, monkeypatch):
    model = make("wide", guidance_target=target, n_action_candidates=2).learn(60)
    model.set_causal_graph(CausalGraph.fully_connected(model.transition_variables))
    rows = np.random.default_rng(0).normal(size=(3, N_STATES + 20))
    of_all = model.predict(rows, deterministic=True)[0]
    hide_noises(model)
    assert model.policy.is_guided and model.world_model.modelled_indices is not None
    in_numpy = model.predict(rows, deterministic=True)[0]
    assert model.policy._acting is not None and not np.allclose(in_numpy, of_all, atol=1e-4)
    monkeypatch.setattr(switch, "is_on", lambda: False)
    model.policy._acting = None
    in_torch = model.predict(rows, deterministic=True)[0]
    assert model.policy._acting is None
    np.testing.assert_allclose(in_numpy, in_torch, atol=1e-5)


def test_a_loaded_model_models_what_it_shows():
    model = make("wide").learn(60)
    hide_noises(model)
    stream = io.BytesIO()
    model.save(stream)
    loaded = CausalGDP.load(stream, env=ENVIRONMENTS["wide"](), device="cpu")
    assert th.equal(loaded.world_model.modelled_states, model.world_model.modelled_states)
    assert CausalGDP.load(stream, device="cpu", causal_abstraction=False).world_model.modelled_states.all()


# What decides ----------------------------------------------------------------------------------------------------------------


def graph_of(variables, relevant=("obs[0]", "action[0]"), rows=10_000):
    masks = np.eye(variables.n_states + 1, variables.n_states + variables.n_actions)
    masks[-1] = [name in relevant for name in (*variables.state_names, *variables.action_names)]
    return CausalGraph(variables, masks, np.zeros_like(masks), method="by hand", n_samples=rows)


def by_hand(statistics, variables, previous):
    return graph_of(variables)


class Logged(CausalWorldModelCallback):
    def refresh(self):
        super().refresh()
        values = self.logger.name_to_value
        self.model.seen.append((values.get("causal/n_closed_states"), values.get("causal/n_closed_actions")))


def test_a_second_verdict_hides_and_the_log_says_so():
    model = make(causal_discovery=by_hand, causal_refresh_freq=200)
    model.seen = []
    model.learn(650, callback=Logged())
    assert model.seen == [(None, None), (0, 0), (4, 2)]  # the first comes too early for a graph
    assert model.policy.state_gate.tolist() == [1, 0, 0, 0, 0] and model.policy.action_gate.tolist() == [1, 0, 0]
    assert model.policy.critic.features_extractor.inverse_std.ne(0).tolist() == [True, False, False, False, False]
    verdict = model.judge_relevance(graph_of(model.transition_variables, ("obs[0]", "obs[2]", "action[0]")))
    assert verdict.opened == ("obs[2]",)
    assert model.policy.state_gate.tolist() == [1, 0, 1, 0, 0]
    assert model.policy.actor.features_extractor.inverse_std[2] > 0


def test_discovery_finds_what_does_not_matter():
    model = make(batch_size=4, train_freq=100, gradient_steps=1, causal_refresh_freq=500).learn(2500)
    assert model.relevance_gate.states[0] and model.relevance_gate.actions[0]
    assert (~model.relevance_gate.states).sum() >= 3 and (~model.relevance_gate.actions).sum() >= 1
    assert model.predict(np.zeros(N_STATES), deterministic=True)[0][~model.relevance_gate.actions].any() == False  # noqa: E712


def test_where_no_state_is_known_to_matter_nothing_is_hidden():
    model = make()
    graph = graph_of(model.transition_variables, ("action[0]",))
    for _ in range(5):
        verdict = model.judge_relevance(graph)
    assert verdict.states.all() and verdict.actions.all() and verdict.withheld


class Battery(gym.Wrapper):
    """The last observation runs down by the second action, and ends the episode; it is in no reward."""

    def reset(self, **kwargs):
        observation, info = self.env.reset(**kwargs)
        self.charge = 1.0
        return self._with_charge(observation), info

    def step(self, action):
        observation, reward, _, truncated, info = self.env.step(action)
        self.charge -= 0.1 + 0.1 * float(action[1])
        return self._with_charge(observation), reward, self.charge < 0.0, truncated, info

    def _with_charge(self, observation):
        return np.array([*observation[:-1], self.charge])


@pytest.mark.parametrize("efficient", [False, True])
def test_what_ends_episodes_matters(efficient):
    memory = {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}}
    kwargs = {"batch_size": 4, "train_freq": 100, "causal_refresh_freq": 500, **(memory if efficient else {})}
    model = CausalGDP("MlpPolicy", Battery(Cart()), causal_abstraction=True, **{**SMALL, **kwargs}).learn(2000)
    assert model.relevance_gate.states[-1] and model.relevance_gate.actions[1]
    assert not model.relevance_gate.states.all()
    # By the rewards alone it would be hidden
    for _ in range(2):
        verdict = model.judge_relevance(model.causal_graph())
    assert not verdict.states[-1] and not verdict.actions[1]


def test_goals_are_never_hidden():
    model = CausalGDP("MultiInputPolicy", GoalEnv(), causal_abstraction=True, replay_buffer_class=HerReplayBuffer, **SMALL)
    variables = model.transition_variables
    first = variables.state_names[[name.startswith("observation") for name in variables.state_names].index(True)]
    for _ in range(4):
        verdict = model.judge_relevance(graph_of(variables, (first, "action[0]")))
    shown = {name for name, is_open in zip(variables.state_names, verdict.states, strict=True) if is_open}
    goals = {name for name in variables.state_names if "goal" in name}
    assert goals and shown == {first} | goals
    model.learn(60)


def test_actions_that_would_never_move_again_are_not_hidden():
    model = make(exploration_noise=0.0)
    for _ in range(4):
        verdict = model.judge_relevance(graph_of(model.transition_variables))
    assert verdict.actions.all() and not verdict.states.all()


def test_options_are_those_of_the_gate():
    model = make(abstraction={"patience": 1, "keep_open": ["obs[4]"]})
    verdict = model.judge_relevance(graph_of(model.transition_variables))
    assert verdict.states.tolist() == [True, False, False, False, True]


@pytest.mark.parametrize(
    ("abstraction", "message"),
    [
        ({"patiense": 3}, "causal_abstraction: RelevanceGate has no argument 'patiense', did you mean 'patience'?"),
        ({"low": 2.0}, "causal_abstraction: low and high must be in"),
        ({"keep_open": ["obs[9]"]}, r"causal_abstraction: keep_open must be names among .*, got \['obs\[9\]'\]"),
        ({"keep_open": "obs[1]"}, "causal_abstraction: keep_open must be a list of names"),
        ("yes", "causal_abstraction must be True or False or a dictionary .* or 'auto', got 'yes'"),
    ],
)
def test_mistakes_are_named(abstraction, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make(abstraction=abstraction)


def test_images_are_refused():
    env = gym.make("Pendulum-v1")
    env.observation_space = spaces.Box(0, 255, (3, 64, 64), np.uint8)
    with pytest.raises(ValueError, match="causal_abstraction must be False with images"):
        CausalGDP("CnnPolicy", env, causal_abstraction=True, **SMALL)


# Offline, files --------------------------------------------------------------------------------


def test_offline_pretraining_hides_too(tmp_path):
    source = make(abstraction=False).learn(300)
    source.save_replay_buffer(tmp_path / "buffer.pkl")
    model = make(causal_discovery=by_hand, causal_refresh_freq=20)
    model.load_replay_buffer(tmp_path / "buffer.pkl", trusted=True)
    model.pretrain(60)
    assert model.policy.state_gate.tolist() == [1, 0, 0, 0, 0]


def assert_same_verdict(model, other):
    assert other.relevance_gate.state_dict() == model.relevance_gate.state_dict()
    for name, value in model.policy.state_dict().items():
        assert th.equal(value, other.policy.state_dict()[name]), name
    rows = np.random.default_rng(0).normal(size=(3, N_STATES))
    actions = [one.predict(rows, deterministic=True)[0] for one in (model, other)]
    np.testing.assert_array_equal(*actions)
    assert not actions[1][:, 2].any()


def test_the_verdict_survives_files(tmp_path):
    model = make(causal_discovery_kwargs={}, causal_refresh_freq=1000).learn(60)
    for _ in range(2):
        model.judge_relevance(graph_of(model.transition_variables))
    model.train(8, 8)
    stream = io.BytesIO()
    model.save(stream)
    loaded = CausalGDP.load(stream, env=Cart(), device="cpu")
    assert_same_verdict(model, loaded)
    assert loaded.judge_relevance(graph_of(loaded.transition_variables, ("obs[2]", "action[0]"))).opened == ("obs[2]",)
    model.policy.save(tmp_path / "policy.pt")
    policy = CausalGDPPolicy.load(tmp_path / "policy.pt", device="cpu")
    rows = np.random.default_rng(0).normal(size=(3, N_STATES))
    np.testing.assert_array_equal(
        policy.predict(rows, deterministic=True)[0], model.policy.predict(rows, deterministic=True)[0]
    )
    assert th.equal(policy.actor.action_gate, model.actor.action_gate)


def test_a_model_without_abstraction_gets_it_and_one_with_it_loses_it():
    plain, hidden = io.BytesIO(), io.BytesIO()
    make(abstraction=False).learn(60).save(plain)
    loaded = CausalGDP.load(plain, env=Cart(), device="cpu", causal_abstraction=True)
    assert loaded.policy.state_gate.all() and loaded.actor.action_gate.all()
    hide(loaded)
    loaded.learn(40)
    loaded.save(hidden)
    again = CausalGDP.load(hidden, env=Cart(), device="cpu", causal_abstraction=False)
    rows, others = changed_rows(loaded, 1)
    # It sees everything, with weights of 0
    np.testing.assert_array_equal(*(again.predict(one, deterministic=True)[0] for one in (rows, others)))
    again.learn(40)
    assert not np.array_equal(*(again.predict(one, deterministic=True)[0] for one in (rows, others)))


# The default ------------------------------------------------------------------------------------------------------------


def test_by_default_what_does_not_matter_is_hidden():
    model = CausalGDP("MlpPolicy", Cart(), **SMALL).learn(1000)
    gates = model.policy.state_gate, model.policy.action_gate
    assert gates[0][0] == gates[1][0] == 1.0 and gates[0].sum() < N_STATES and gates[1].sum() < N_ACTIONS


IMAGE = spaces.Box(0, 255, (1, 36, 36), np.uint8)


class OwnFeatures(FlattenExtractor):
    pass


@pytest.mark.parametrize(
    ("policy", "space", "kwargs"),
    [
        ("CnnPolicy", IMAGE, {}),
        ("MultiInputPolicy", spaces.Dict({"image": IMAGE, "speed": spaces.Box(-1.0, 1.0, (1,))}), {}),
        ("MlpPolicy", spaces.Box(-1.0, 1.0, (3,)), {"policy_kwargs": {"denoiser": "transformer"}}),
        ("MlpPolicy", spaces.Box(-1.0, 1.0, (3,)), {"actor_update": "trust_region"}),
        ("MlpPolicy", spaces.Box(-1.0, 1.0, (3,)), {"policy_kwargs": {"features_extractor_class": OwnFeatures}}),
    ],
)
def test_by_default_all_is_seen_where_nothing_can_be_hidden(policy, space, kwargs):
    env = gym.make("Pendulum-v1")
    env.observation_space = space
    model = CausalGDP(policy, env, **{**SMALL, **kwargs})
    assert not model.policy.causal_abstraction and model.relevance_gate is None


def test_a_distilled_policy_does_not_see_what_its_teacher_does_not(trained, tmp_path):
    student = trained.distil(n_observations=100, gradient_steps=20)
    student.save(tmp_path / "student.zip")
    seen, otherwise = np.ones(N_STATES), np.ones(N_STATES)
    otherwise[HIDDEN_STATES] = 7.0
    for policy in (student, CausalGDPPolicy.load(tmp_path / "student.zip")):
        actions = [policy.predict(one, deterministic=True)[0] for one in (seen, otherwise, 1.5 * seen)]
        np.testing.assert_array_equal(actions[0], actions[1])
        assert not np.array_equal(actions[0], actions[2])


def test_where_everything_matters_the_default_changes_no_number():
    numbers = [
        th.cat([p.flatten() for p in CausalGDP("MlpPolicy", "Pendulum-v1", **SMALL, **kwargs).learn(400).policy.parameters()])
        for kwargs in ({}, {"causal_abstraction": False})
    ]
    assert th.equal(*numbers)
