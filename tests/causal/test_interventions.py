import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from matplotlib.figure import Figure
from matplotlib.text import Text

from sb3_causalgdp import causal
from sb3_causalgdp.causal import MaskedWorldModel, StructuralModel, TransitionVariables
from sb3_causalgdp.causal.plots.effects import plot_action_effects, plot_next_state_effects, plot_reward_effects

VARIABLES = TransitionVariables(("x", "y", "z"), ("u", "v"))
# s' = A s + B a, r = c s' + e a, in the model's units. u moves x and y, v moves z alone; z has no path to x and y.
A = np.array([[0.9, 0.1, 0.0], [0.0, 0.8, 0.0], [0.2, 0.0, 0.7]])
B = np.array([[0.5, 0.0], [-0.3, 0.0], [0.0, 0.4]])
C = np.array([1.0, -2.0, 0.0])
E = np.array([0.6, -0.5])
STATE_STD = np.array([0.1, 0.2, 0.05])
REWARD_STD = 0.3
SLOPE = 1e-2  # of the hidden units: so small that tanh is linear


def linear_world_model():
    """A model that is the linear system: block j hands each input to one hidden unit, close to 0."""
    model = MaskedWorldModel(3, 2, [16]).double()
    is_open = [th.as_tensor(matrix != 0.0, dtype=th.float64) for matrix in (A, B, C, E)]
    model.set_masks(*is_open)
    with th.no_grad():
        # The residual path carries s_j where its mask is open
        rows = {"transition": np.hstack([A - np.diag(np.diag(A) != 0.0), B]), "reward": np.append(C, E)[None]}
        for name, weights in rows.items():
            blocks = getattr(model, name)
            blocks.input_layer.weight.zero_().view(blocks.n_outputs, blocks.width, 5)[:, :5] = SLOPE * th.eye(5)
            blocks.input_layer.bias.zero_()
            blocks.output_weight.zero_()[:, :5] = th.as_tensor(weights) / SLOPE
        model.transition_log_std.copy_(th.as_tensor(STATE_STD).log())
        model.reward_log_std.fill_(float(np.log(REWARD_STD)))
    return model


@pytest.fixture(scope="module")
def linear():
    return StructuralModel(linear_world_model(), VARIABLES)


@pytest.fixture(scope="module")
def in_other_units():
    """The same system in an environment whose states, actions and rewards the model saw scaled."""
    return StructuralModel(
        linear_world_model(),
        VARIABLES,
        action_low=[-2.0, 0.0],
        action_high=[2.0, 10.0],
        state_offset=[1.0, -100.0, 0.0],
        state_scale=[2.0, 10.0, 0.1],
        reward_scale=5.0,
    )


def draw(n_rows=7, seed=0):
    generator = np.random.default_rng(seed)
    return 0.5 * generator.standard_normal((n_rows, 3)), generator.uniform(-1.0, 1.0, (n_rows, 2))


# Interventions ----------------------------------------------------------------------------------------------------------


def test_without_interventions_it_is_the_prediction(linear):
    states, actions = draw()
    outcome = linear.intervene(states, actions, {})
    next_states = states @ A.T + actions @ B.T
    np.testing.assert_allclose(outcome.next_state, next_states, atol=1e-3)
    np.testing.assert_allclose(outcome.next_state_std, np.tile(STATE_STD, (7, 1)))
    np.testing.assert_allclose(outcome.reward, next_states @ C + actions @ E, atol=1e-3)
    expected = np.sqrt(REWARD_STD**2 + ((C * STATE_STD) ** 2).sum())
    np.testing.assert_allclose(outcome.reward_std, expected, rtol=1e-3)


def test_setting_states_and_actions_replaces_the_inputs(linear):
    states, actions = draw()
    outcome = linear.intervene(states, actions, {"y": 0.4, "u": -0.7})
    states[:, 1], actions[:, 0] = 0.4, -0.7
    for values, expected in zip(outcome, linear.intervene(states, actions, {}), strict=True):
        np.testing.assert_array_equal(values, expected)


def test_setting_a_next_state_cuts_what_causes_it_and_reaches_the_reward(linear):
    states, actions = draw()
    outcome, plain = linear.intervene(states, actions, {"x'": 0.3}), linear.intervene(states, actions, {})
    np.testing.assert_array_equal(outcome.next_state[:, 0], 0.3)
    np.testing.assert_array_equal(outcome.next_state[:, 1:], plain.next_state[:, 1:])
    np.testing.assert_array_equal(outcome.next_state_std[:, 0], 0.0)
    np.testing.assert_allclose(outcome.reward - plain.reward, 0.3 - plain.next_state[:, 0], atol=1e-3)
    np.testing.assert_allclose(outcome.reward_std, np.hypot(REWARD_STD, 2.0 * STATE_STD[1]), rtol=1e-3)
    # Its causes have no more say
    other = linear.intervene(states, actions, {"x'": 0.3, "x": -0.2})
    np.testing.assert_array_equal(other.reward, outcome.reward)


def test_one_observation_and_a_batch_agree(linear):
    states, actions = draw()
    batch = linear.intervene(states, actions, {"v": np.linspace(-1.0, 1.0, 7)})
    single = linear.intervene(states[2], actions[2], {"v": np.linspace(-1.0, 1.0, 7)[2]})
    for one, many in zip(single, batch, strict=True):
        assert one.shape == many.shape[1:]
        np.testing.assert_allclose(one, many[2])
    repeated = linear.intervene(states, actions[0], {})
    np.testing.assert_allclose(repeated.reward[3], linear.intervene(states[3], actions[0], {}).reward)


def test_everything_is_in_the_units_of_the_environment(linear, in_other_units):
    states, actions = draw()
    own_states = states * [2.0, 10.0, 0.1] + [1.0, -100.0, 0.0]
    own_actions = actions * [2.0, 5.0] + [0.0, 5.0]
    outcome = in_other_units.intervene(own_states, own_actions, {"u": 1.0, "y": -97.0, "z'": 0.02})
    expected = linear.intervene(states, actions, {"u": 0.5, "y": 0.3, "z'": 0.2})
    np.testing.assert_allclose(outcome.next_state, expected.next_state * [2.0, 10.0, 0.1] + [1.0, -100.0, 0.0])
    np.testing.assert_allclose(outcome.next_state_std, expected.next_state_std * [2.0, 10.0, 0.1])
    np.testing.assert_allclose(outcome.reward, 5.0 * expected.reward)
    np.testing.assert_allclose(outcome.reward_std, 5.0 * expected.reward_std)


def test_states_are_clipped_as_the_model_saw_them():
    clipped = StructuralModel(linear_world_model(), VARIABLES, state_scale=2.0, state_clip=[0.5, np.inf, np.inf])
    inside, outside = (clipped.intervene([x, 0.0, 0.0], [0.0, 0.0], {}) for x in (1.0, 7.0))
    np.testing.assert_array_equal(inside.next_state, outside.next_state)
    # A next state on the clip does not move the reward
    assert clipped.intervene([0.0] * 3, [0.0, 0.0], {"x'": 7.0, "y'": 0.0}).reward_std == pytest.approx(REWARD_STD)


def test_sampling_agrees_with_the_delta_method_where_the_reward_is_linear(linear):
    states, actions = draw()
    sampled, delta = linear.intervene(states, actions, {}, n_samples=20_000), linear.intervene(states, actions, {})
    np.testing.assert_allclose(sampled.reward, delta.reward, atol=0.02)
    np.testing.assert_allclose(sampled.reward_std, delta.reward_std, rtol=0.03)
    again = linear.intervene(states, actions, {}, n_samples=20_000)
    np.testing.assert_array_equal(sampled.reward, again.reward)


def test_sampling_sees_the_curvature_that_the_delta_method_does_not():
    model = linear_world_model()
    with th.no_grad():
        # r = tanh(8 x'): flat where x' is large, steep at 0
        model.reward.input_layer.weight.zero_()[0, 0] = 8.0
        model.reward.output_weight.zero_()[0, 0] = 1.0
        model.transition_log_std[0] = 0.0
    structural = StructuralModel(model, VARIABLES)
    delta = structural.intervene([0.0] * 3, [0.0, 0.0], {})
    sampled = structural.intervene([0.0] * 3, [0.0, 0.0], {}, n_samples=5_000)
    assert delta.reward_std == pytest.approx(np.hypot(REWARD_STD, 8.0))
    assert sampled.reward_std < np.hypot(REWARD_STD, 1.0)


BAD_INTERVENTIONS = [
    ({"w": 1.0}, r"Unknown variables \['w'\]: known are \['x', 'y', 'z', 'u', 'v', \"x'\", \"y'\", \"z'\"\]"),
    ({"reward": 1.0}, r"Unknown variables \['reward'\]"),
    ({"x": np.nan}, "x must be set to finite values, got nan"),
    ({"x'": np.inf}, "x' must be set to finite values, got inf"),
    ({"u": 2.5}, r"u must be in \[-2, 2\], got 2.5 \(in interventions, row 0\)"),
    ({"v": -0.1}, r"v must be in \[0, 10\], got -0.1"),
    ({"x": "1"}, "x must be numbers, got '1'"),
    ({"x": [1.0, 2.0]}, r"x must be a number or have shape \(1,\), got \(2,\)"),
]


@pytest.mark.parametrize(("interventions", "message"), BAD_INTERVENTIONS)
def test_bad_interventions_are_errors(in_other_units, interventions, message):
    with pytest.raises(ValueError, match=message):
        in_other_units.intervene([1.0, -100.0, 0.0], [0.0, 5.0], interventions)


def test_bad_observations_and_actions_are_errors(in_other_units):
    state, action = [1.0, -100.0, 0.0], [0.0, 5.0]
    for bad_state, bad_action, message in (
        ([1.0, 2.0], action, r"observation must have shape \(3,\) or \(batch, 3\), got \(2,\)"),
        ([1.0, np.nan, 0.0], action, "observation must be finite, got nan"),
        (state, [0.0, 11.0], r"v must be in \[0, 10\], got 11 \(in action, row 0\)"),
        ([state] * 3, [action] * 2, "There are 3 observations but 2 actions"),
        (np.zeros((0, 3)), action, "observation must have shape"),
    ):
        with pytest.raises(ValueError, match=message):
            in_other_units.intervene(bad_state, bad_action, {})
    with pytest.raises(ValueError, match="n_samples must be at least 2"):
        in_other_units.intervene(state, action, {}, n_samples=1)


def test_long_lists_of_names_are_cut():
    variables = TransitionVariables(tuple(f"s{i}" for i in range(60)), ("a",))
    with pytest.raises(ValueError, match="'s39'] and 81 more"):
        StructuralModel(MaskedWorldModel(60, 1, [8]), variables).intervene(np.zeros(60), [0.0], {"t": 0.0})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"action_low": 1.0}, "Action bounds must be finite and ordered"),
        ({"action_high": np.inf}, "Action bounds must be finite and ordered"),
        ({"state_scale": [1.0, 0.0, 1.0]}, "state_scale must be positive"),
        ({"state_offset": [1.0, 2.0]}, r"state_offset must be a number or have shape \(3,\), got \(2,\)"),
        ({"reward_scale": -1.0}, "reward_scale must be positive"),
    ],
)
def test_bad_units_are_errors(arguments, message):
    with pytest.raises(ValueError, match=message):
        StructuralModel(linear_world_model(), VARIABLES, **arguments)
    with pytest.raises(ValueError, match="name 3 states and 2 actions, but the world model has 4 and 2"):
        StructuralModel(MaskedWorldModel(4, 2, [8]), VARIABLES)


# Effects ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delta", [None, 0.5, [0.1, 3.0]])
def test_effects_of_a_linear_system_are_its_coefficients(in_other_units, delta):
    states, actions = draw(50)
    own = states * [2.0, 10.0, 0.1] + [1.0, -100.0, 0.0], actions * [2.0, 5.0] + [0.0, 5.0]
    effects = in_other_units.effect_of_actions(*own, delta=delta)
    per_unit = 5.0 / np.array([2.0, 5.0])
    np.testing.assert_allclose(effects.reward_direct.mean, E * per_unit, rtol=2e-3)
    np.testing.assert_allclose(effects.reward_through_state.mean, C @ B * per_unit, atol=2e-3)
    np.testing.assert_allclose(effects.reward.mean, (E + C @ B) * per_unit, rtol=2e-3)
    np.testing.assert_allclose(effects.reward.mean_absolute, np.abs(effects.reward.mean))
    np.testing.assert_allclose(effects.next_state.mean, B * np.array([[2.0], [10.0], [0.1]]) / [2.0, 5.0], rtol=2e-3)
    assert effects.reward.standard_error.max() < 1e-3
    # The model's states and rewards have standard deviation 1
    standardised = effects.standardised()
    np.testing.assert_allclose(standardised.reward.mean, E + C @ B, rtol=2e-3)
    np.testing.assert_allclose(standardised.next_state.mean, B, rtol=2e-3)
    assert standardised.standardised() is standardised and not effects.is_standardised


@pytest.mark.parametrize("delta", [None, 0.2])
def test_where_the_masks_let_no_path_the_effect_is_exactly_zero(linear, delta):
    effects = linear.effect_of_actions(*draw(50), delta=delta)
    np.testing.assert_array_equal(effects.next_state.mean_absolute[B == 0.0], 0.0)
    # v moves z alone, of which the reward knows nothing
    assert effects.reward_through_state.mean_absolute[1] == 0.0
    assert effects.reward_direct.mean_absolute[1] > 0.0


def test_mean_and_mean_absolute_effect_part_where_the_sign_depends_on_the_state(monkeypatch):
    th.manual_seed(0)
    model = MaskedWorldModel(3, 2, [16, 16])
    structural = StructuralModel(model, VARIABLES)
    states, actions = draw(300)
    effects = structural.effect_of_actions(states, actions)
    response = model.action_response(th.as_tensor(states).float(), th.as_tensor(actions).float())
    by_reward = response.reward_jacobian.double().numpy()
    np.testing.assert_allclose(effects.reward.mean, by_reward.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(effects.reward.mean_absolute, np.abs(by_reward).mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(effects.reward.standard_error, by_reward.std(axis=0, ddof=1) / np.sqrt(300), rtol=1e-4)
    # In pieces the same
    monkeypatch.setattr(StructuralModel, "ROWS_PER_CHUNK", 64)
    np.testing.assert_allclose(structural.effect_of_actions(states, actions).next_state.mean, effects.next_state.mean)


def test_the_difference_quotient_of_a_small_step_is_the_derivative_and_of_a_large_one_stays_in_the_bounds():
    th.manual_seed(0)
    structural = StructuralModel(MaskedWorldModel(3, 2, [16, 16]).double(), VARIABLES, -3.0, 3.0)
    states, actions = draw(20)
    derivative, small = (structural.effect_of_actions(states, 3.0 * actions, delta=delta) for delta in (None, 1e-4))
    for name in ("reward", "reward_direct", "reward_through_state", "next_state"):
        np.testing.assert_allclose(getattr(small, name).mean, getattr(derivative, name).mean, rtol=1e-5)
    large = structural.effect_of_actions(states, 3.0 * actions, delta=100.0)
    low, high = (structural.intervene(states, 3.0 * actions, {"u": value}).reward for value in (-3.0, 3.0))
    assert large.reward.mean[0] == pytest.approx(((high - low) / 6.0).mean())


def test_a_single_observation_has_no_standard_error(linear):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        effects = linear.effect_of_actions([0.1, 0.2, 0.3], [0.0, 0.5])
    assert np.isnan(effects.reward.standard_error).all() and effects.n_observations == 1


@pytest.mark.parametrize("delta", [0.0, -1.0, np.nan, np.inf])
def test_bad_steps_are_errors(linear, delta):
    with pytest.raises(ValueError, match="delta must be"):
        linear.effect_of_actions(*draw(), delta=delta)


# Plots of effects -------------------------------------------------------------------------------------------------------


def random_effects(n_states, n_actions, n_observations=20):
    th.manual_seed(0)
    names = tuple(f"obs[{i}]" for i in range(n_states)), tuple(f"action[{i}]" for i in range(n_actions))
    structural = StructuralModel(MaskedWorldModel(n_states, n_actions, [8, 8]), TransitionVariables(*names))
    generator = np.random.default_rng(0)
    states = generator.standard_normal((n_observations, n_states))
    return structural.effect_of_actions(states, generator.uniform(-1.0, 1.0, (n_observations, n_actions)))


def labels(axis):
    return [label.get_text() for label in axis.get_ticklabels()]


@pytest.mark.parametrize("size", [(1, 1), (17, 6), (60, 30)])
def test_plot_writes_an_image_without_a_warning(tmp_path, size):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = random_effects(*size).plot(tmp_path / "effects.png")
        random_effects(*size, n_observations=1).plot()
    assert isinstance(figure, Figure)
    assert (tmp_path / "effects.png").stat().st_size > 5_000


def test_long_lists_show_the_strongest_and_say_so():
    effects = random_effects(60, 30)
    bars = plot_reward_effects(effects, max_actions=5)
    strongest = np.argsort(-effects.reward.mean_absolute)[:5]
    assert labels(bars.yaxis) == [f"action[{i}]" for i in strongest]
    assert "the 5 actions with the strongest effect, of 30" in bars.get_title()
    heat_map = plot_next_state_effects(effects, max_actions=5, max_states=8)
    assert labels(heat_map.xaxis) == [f"action[{i}]" for i in sorted(strongest)]
    assert len(labels(heat_map.yaxis)) == 8
    assert "the 8 variables with the strongest effect, of 60" in heat_map.get_title()
    for arguments in ({"max_actions": 0}, {"max_states": 0}):
        with pytest.raises(ValueError, match="must be at least 1, got 0"):
            plot_action_effects(effects, **arguments)


def test_the_heat_map_leaves_out_what_has_no_path(linear):
    axes = plot_next_state_effects(linear.effect_of_actions(*draw(50)))
    np.testing.assert_array_equal(axes.images[0].get_array().mask, B == 0.0)
    assert "no path" in axes.get_xlabel()


def test_a_dollar_sign_in_a_name_is_a_dollar_sign(tmp_path):
    variables = TransitionVariables(("a_$x_$b", "y", "$/m^2 and $/m_"), ("cash $$", "v"))
    effects = StructuralModel(linear_world_model(), variables).effect_of_actions(*draw(50))
    figure = plot_action_effects(effects, tmp_path / "effects.png")
    shown = [text for text in figure.findobj(Text) if "$" in text.get_text()]
    assert {"cash $$", "a_$x_$b'"} <= {text.get_text() for text in shown}
    assert not any(text.get_parse_math() for text in shown)


def test_missing_matplotlib_says_what_to_install(monkeypatch, linear):
    for name in [name for name in sys.modules if name.startswith("sb3_causalgdp.causal.plots")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr(causal, "plots")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"pip install matplotlib networkx pandas"):
        linear.effect_of_actions(*draw()).plot()


# Counterfactuals --------------------------------------------------------------------------------------------------------


def linear_trajectory(n_steps=30, seed=0, actions=None):
    """Of the true system, with the noise of the seed."""
    generator = np.random.default_rng(seed)
    taken = 0.5 * np.sin(np.arange(n_steps))[:, None] * [1.0, -1.0] if actions is None else actions
    states, rewards = [np.array([0.2, -0.1, 0.3])], []
    for action in taken:
        states.append(A @ states[-1] + B @ action + STATE_STD * generator.standard_normal(3))
        rewards.append(C @ states[-1] + E @ action + REWARD_STD * generator.standard_normal())
    return np.array(states), taken, np.array(rewards)


def test_no_change_gives_the_recording_back_bit_by_bit(linear):
    recorded = linear_trajectory()
    for arguments in ({}, {"policy": lambda state: 0.1 * state[:2]}):
        unchanged = linear.counterfactual(recorded, {}, **arguments)
        for values, expected in zip(unchanged[:3], recorded, strict=True):
            np.testing.assert_array_equal(values, expected)


def test_the_noise_is_found(linear):
    generator = np.random.default_rng(0)
    noise = np.array([generator.standard_normal(4) for _ in range(30)])
    counterfactual = linear.counterfactual(linear_trajectory(), {"u": 0.0})
    np.testing.assert_allclose(counterfactual.state_noise, noise[:, :3], atol=0.02)
    np.testing.assert_allclose(counterfactual.reward_noise, noise[:, 3], atol=0.02)


def test_the_counterfactual_is_what_the_system_does_with_the_same_noise(linear):
    states, actions, rewards = linear_trajectory()
    changed = actions.copy()
    changed[10:, 0] = -0.4
    truth = linear_trajectory(actions=changed)
    counterfactual = linear.counterfactual((states, actions, rewards), {"u": changed[:, 0]})
    for values, expected in zip(counterfactual[:3], truth, strict=True):
        np.testing.assert_allclose(values, expected, atol=2e-3)
    by_rule = linear.counterfactual((states, actions, rewards), {"u": lambda t, s, a: -0.4 if t >= 10 else a[0]})
    np.testing.assert_array_equal(by_rule.states, counterfactual.states)


def test_what_the_change_cannot_reach_stays_exactly_as_recorded(linear):
    recorded = linear_trajectory()
    counterfactual = linear.counterfactual(recorded, {"v": 1.0})
    np.testing.assert_array_equal(counterfactual.states[:, :2], recorded[0][:, :2])
    assert np.abs(counterfactual.states[1:, 2] - recorded[0][1:, 2]).min() > 1e-3
    # r sees v itself
    assert np.abs(counterfactual.rewards - recorded[2]).min() > 1e-3


def test_a_random_network_keeps_to_its_masks_over_a_whole_episode():
    th.manual_seed(0)
    model = MaskedWorldModel(3, 2, [16, 16])
    model.set_masks(*(th.as_tensor(matrix != 0.0, dtype=th.float32) for matrix in (A, B, C, np.array([1.0, 0.0]))))
    recorded = linear_trajectory(200)
    counterfactual = StructuralModel(model, VARIABLES).counterfactual(recorded, {"v": 0.9})
    np.testing.assert_array_equal(counterfactual.states[:, :2], recorded[0][:, :2])
    np.testing.assert_array_equal(counterfactual.rewards, recorded[2])
    assert not np.array_equal(counterfactual.states[:, 2], recorded[0][:, 2])


def test_rules_see_the_counterfactual_state_and_the_recorded_action(linear):
    recorded, seen = linear_trajectory(5), []

    def rule(t, state, action):
        seen.append((t, state, action))
        return 0.5 * action[0]

    counterfactual = linear.counterfactual(recorded, {"u": rule})
    np.testing.assert_array_equal(counterfactual.actions[:, 0], 0.5 * recorded[1][:, 0])
    np.testing.assert_array_equal(counterfactual.actions[:, 1], recorded[1][:, 1])
    assert [t for t, _, _ in seen] == list(range(5))
    np.testing.assert_array_equal([state for _, state, _ in seen], counterfactual.states[:-1])
    np.testing.assert_array_equal([action for _, _, action in seen], recorded[1])


def test_the_policy_reacts_with_what_is_not_changed(linear):
    states, actions, rewards = linear_trajectory()

    def policy(state):
        return np.tanh([state[1], state[0]])

    own = linear.counterfactual((states, actions, rewards), {"u": 0.3}, policy)
    expected = np.tanh(own.states[:-1, 0]) + actions[:, 1] - np.tanh(states[:-1, 0])
    np.testing.assert_allclose(own.actions[:, 1], expected.clip(-1.0, 1.0))
    np.testing.assert_array_equal(own.actions[:, 0], 0.3)
    other = linear.counterfactual((states, actions, rewards), {"u": 0.3}, policy, abduct_policy=False)
    np.testing.assert_allclose(other.actions[:, 1], np.tanh(other.states[:-1, 0]))


def test_bad_trajectories_and_changes_are_errors(linear):
    states, actions, rewards = linear_trajectory(4)
    for trajectory, message in (
        ((states[:-1], actions, rewards), "T \\+ 1 states, T actions and T rewards, got 4 states, 4 actions"),
        ((states, actions, rewards[:-1]), r"got 5 states, 4 actions and rewards of shape \(3,\)"),
        ((states, actions), "must be \\(states, actions, rewards\\), got 2 parts"),
        ((states, actions, rewards * np.nan), "rewards of the trajectory must be finite"),
        ((states, 3.0 + actions, rewards), r"u must be in \[-1, 1\], got 3 \(in actions of the trajectory, row 0\)"),
    ):
        with pytest.raises(ValueError, match=message):
            linear.counterfactual(trajectory, {})
    for changes, message in (
        ({"x": 1.0}, r"a counterfactual changes actions, \['u', 'v'\], got the state 'x'"),
        ({"u": [0.1, 0.2]}, r"u must be a number or have shape \(4,\), got \(2,\)"),
        ({"u": np.nan}, "u must be set to finite values, got nan"),
        ({"u": 1.5}, r"u must be in \[-1, 1\], got 1.5 \(in changes, step 0"),
        ({"v": lambda t, s, a: 9.0 if t == 2 else 0.0}, r"v must be in \[-1, 1\], got 9 \(in changes, step 2"),
        ({"v": lambda t, s, a: np.nan}, "changes, step 0 must be finite, got nan"),
    ):
        with pytest.raises(ValueError, match=message):
            linear.counterfactual((states, actions, rewards), changes)
    with pytest.raises(ValueError, match="the policy's answer must have shape"):
        linear.counterfactual((states, actions, rewards), {}, lambda state: [0.0, 0.0, 0.0])


# A real environment -----------------------------------------------------------------------------------------------------


def play_pendulum(actions, wind, seed):
    """Pendulum with a wind: a torque that is added to the action and that nobody records."""
    env = gym.make("Pendulum-v1").unwrapped
    states, rewards = [env.reset(seed=seed)[0]], []
    for action, gust in zip(actions, wind, strict=True):
        state, reward, _, _, _ = env.step(action + gust)
        states.append(state)
        rewards.append(float(reward))
    return np.array(states, dtype=np.float64), actions, np.array(rewards)


def pendulum_model(n_updates=800):
    generator = np.random.default_rng(0)
    episodes = [
        play_pendulum(generator.uniform(-2, 2, (100, 1)), generator.normal(0, 0.5, (100, 1)), seed) for seed in range(30)
    ]
    columns = [np.concatenate(parts) for parts in zip(*((s[:-1], a / 2, s[1:], r) for s, a, r in episodes), strict=True)]
    state, action, next_state, reward = (th.as_tensor(column, dtype=th.float32) for column in columns)
    th.manual_seed(0)
    model = MaskedWorldModel(3, 1, [32, 32])
    optimizer = th.optim.Adam(model.parameters(), lr=3e-3)
    for _ in range(n_updates):
        rows = th.randint(len(state), (128,))
        model.update_statistics(state[rows], next_state[rows], reward[rows])
        losses = model.negative_log_likelihood(state[rows], action[rows], next_state[rows], reward[rows])
        optimizer.zero_grad()
        sum(loss.mean() for loss in losses).backward()
        optimizer.step()
    return StructuralModel(model, TransitionVariables(("cos", "sin", "speed"), ("torque",)), -2.0, 2.0)


def test_abduction_beats_prediction_on_a_pendulum_in_the_wind():
    structural, generator = pendulum_model(), np.random.default_rng(1)
    errors = []
    for seed in range(100, 110):
        actions, wind = generator.uniform(-2, 2, (20, 1)), generator.normal(0, 0.5, (20, 1))
        recorded = play_pendulum(actions, wind, seed)
        truth = play_pendulum(0.5 * actions, wind, seed)
        counterfactual = structural.counterfactual(recorded, {"torque": lambda t, s, a: 0.5 * a[0]})
        # Without abduction: the noise-free model rolled out from the same start
        states = [recorded[0][0]]
        for action in 0.5 * actions:
            states.append(structural.intervene(states[-1], action, {}).next_state)
        rewards = [structural.intervene(s, a, {}).reward for s, a in zip(states[:-1], 0.5 * actions, strict=True)]
        errors.append(
            [
                np.sqrt(((counterfactual.states[1:] - truth[0][1:]) ** 2).mean(axis=0)),
                np.sqrt(((np.array(states)[1:] - truth[0][1:]) ** 2).mean(axis=0)),
                [np.sqrt(((counterfactual.rewards - truth[2]) ** 2).mean())] * 3,
                [np.sqrt(((np.array(rewards) - truth[2]) ** 2).mean())] * 3,
            ]
        )
    replayed, predicted, replayed_reward, predicted_reward = np.mean(errors, axis=0)
    assert (replayed < 0.5 * predicted).all(), (replayed, predicted)
    assert replayed_reward[0] < 0.5 * predicted_reward[0], (replayed_reward, predicted_reward)


# Tables and pictures of the answers -------------------------------------------------------------------------------------


def test_an_intervention_is_told_by_name_beside_what_would_be_without(in_other_units):
    state, action = np.array([1.0, -100.0, 0.0]), np.array([0.0, 5.0])
    outcome, plain = (in_other_units.intervene(state, action, values) for values in ({"u": 2.0}, {}))
    mean, std = outcome["x'"]
    assert (mean, std) == (outcome.next_state[0], outcome.next_state_std[0])
    assert outcome["reward"] == (outcome.reward, outcome.reward_std)
    with pytest.raises(KeyError, match="unknown outcome"):
        outcome["w"]
    assert len([*outcome]) == 4 and outcome[2] == outcome.reward
    frame = outcome.to_dataframe().set_index("outcome")
    assert list(frame.index) == ["x'", "y'", "z'", "reward"]
    np.testing.assert_allclose(frame["without"], [*plain.next_state, plain.reward])
    np.testing.assert_allclose(frame["change"], frame["mean"] - frame["without"])
    # u = 2 is half of its range: B u in the model's units, times the scales 2, 10 and 0.1
    np.testing.assert_allclose(frame["change"][:3], [0.5 * 2.0, -0.3 * 10.0, 0.0], atol=1e-2)
    np.testing.assert_allclose(frame["standardised_change"] * outcome.running_std, frame["change"])
    assert abs(frame["standardised_change"]["y'"] - frame["change"]["y'"]) > 1.0
    assert plain.without is None and (plain.to_dataframe()["change"] == 0.0).all()


def test_answers_print_as_a_table_by_name(in_other_units, linear):
    state, action = np.array([1.0, -100.0, 0.0]), np.array([0.0, 5.0])
    outcome = in_other_units.intervene(state, action, {"u": 2.0})
    lines = str(outcome).splitlines()
    assert lines[0] == "Outcomes of an intervention, 1 observation, in the environment's units"
    assert [line.split()[0] for line in lines[1:]] == ["outcome", "reward", "x'", "y'", "z'"]
    assert lines[3].split()[-1] == "+1" and lines[4].split()[-1] == "-3"
    effects = in_other_units.effect_of_actions(state, action)
    printed = {line.split()[0]: line.split()[1:4] for line in str(effects).splitlines()[2:]}
    for i, name in enumerate(("u", "v")):
        parts = (effects.reward, effects.reward_direct, effects.reward_through_state)
        assert printed[name] == [f"{part.mean[i]:+.3g}" for part in parts]
    assert effects.standardised().unit in str(effects.standardised()) and effects.unit in str(effects)
    recorded = linear_trajectory()
    answer = linear.counterfactual(recorded, {"u": -0.4})
    first, _, *rows = str(answer).splitlines()
    assert f"return {answer.rewards.sum():.4g}, recorded {np.sum(recorded[2]):.4g}" in first
    assert len(rows) == 5 and f"u         {np.abs(-0.4 - recorded[1][:, 0]).mean():.3g}" in str(answer)


def test_a_printed_answer_fits_on_a_screen():
    names = tuple(f"s{i}" for i in range(60))
    model = MaskedWorldModel(60, 1, [4]).double()
    structural = StructuralModel(model, TransitionVariables(names, ("a",)))
    outcome = structural.intervene(np.zeros(60), [0.0], {"a": 1.0})
    assert len(str(outcome).splitlines()) <= 25 and "and 41 more, which change less" in str(outcome)


def test_a_batch_has_rows_for_each_observation(linear):
    states, actions = draw(4)
    frame = linear.intervene(states, actions, {"v": 1.0}).to_dataframe()
    assert len(frame) == 16 and frame["observation"].nunique() == 4


def test_effects_are_a_table_that_says_its_units(in_other_units):
    states = np.tile([1.0, -100.0, 0.0], (5, 1))
    effects = in_other_units.effect_of_actions(states, np.tile([0.0, 5.0], (5, 1)))
    raw, standard = effects.to_dataframe(), effects.standardised().to_dataframe()
    assert len(raw) == 2 * (3 + 3)
    row = raw[(raw.action == "u") & (raw.outcome == "y'")].iloc[0]
    np.testing.assert_allclose(row["mean"], effects.next_state.mean[1, 0])
    assert row.unit != standard.unit[0] and not np.allclose(raw["mean"], standard["mean"])
    direct, through, total = (raw[(raw.action == "v") & (raw.part == part)]["mean"].iloc[0] for part in PARTS)
    np.testing.assert_allclose(direct + through, total)


PARTS = ("direct", "through the next state", "total")


def test_a_counterfactual_is_a_table_with_and_without(linear):
    recorded = linear_trajectory()
    answer = linear.counterfactual(recorded, {"u": -0.4})
    frame = answer.to_dataframe()
    n_steps = len(recorded[1])
    assert len(frame) == 3 * (n_steps + 1) + 2 * n_steps + n_steps
    x = frame[frame.variable == "x"]
    np.testing.assert_array_equal(x["recorded"], recorded[0][:, 0])
    np.testing.assert_array_equal(x["counterfactual"], answer.states[:, 0])
    np.testing.assert_allclose(x["standardised_change"] * answer.running_std[0], x["change"])
    assert (frame[frame.variable == "v"]["change"] == 0.0).all()


def test_a_counterfactual_is_drawn_with_and_without_and_a_band_where_they_differ(linear, tmp_path):
    recorded = linear_trajectory()
    changed = recorded[1][:, 0].copy()
    changed[10:] = -0.4
    answer = linear.counterfactual(recorded, {"u": changed})
    figure = answer.plot(tmp_path / "answer.png")
    assert (tmp_path / "answer.png").stat().st_size > 5_000
    panels = {axes.get_ylabel(): axes for axes in figure.axes}
    assert "reward" in panels and "u" in panels and "v" not in panels
    before, after = panels["x"].lines
    np.testing.assert_array_equal(before.get_ydata(), recorded[0][:, 0])
    np.testing.assert_array_equal(after.get_ydata(), answer.states[:, 0])
    band = panels["x"].collections[0].get_paths()[0].vertices
    widths = [np.ptp(band[band[:, 0] == step, 1]) for step in (5, 20)]
    np.testing.assert_allclose(widths, [0.0, 4 * answer.noise_std[0]], atol=1e-9)
    assert list(axes.get_ylabel() for axes in answer.plot(variables=["z", "v"]).axes) == ["z", "v"]
    for arguments, message in (
        ({"variables": ["w"]}, r"variables must be some of .* got \['w'\]"),
        ({"max_variables": 0}, "max_variables"),
    ):
        with pytest.raises(ValueError, match=message):
            answer.plot(**arguments)


def test_an_intervention_is_drawn_with_and_without(in_other_units, tmp_path):
    outcome = in_other_units.intervene(np.array([1.0, -100.0, 0.0]), np.array([0.0, 5.0]), {"u": 2.0})
    (axes,) = outcome.plot(tmp_path / "outcome.png").axes
    without, with_it = axes.lines[:2]
    assert (np.asarray(without.get_xdata()) == 0.0).all()
    np.testing.assert_allclose(with_it.get_xdata(), outcome.to_dataframe()["standardised_change"])
    assert [text.get_text() for text in axes.get_yticklabels()] == ["x'", "y'", "z'", "reward"]
    (axes,) = outcome.plot(max_outcomes=2).axes
    assert len(axes.get_yticks()) == 2 and "(the 2 of 4 outcomes that change most)" in axes.get_title()
    with pytest.raises(ValueError, match="max_outcomes must be at least 1"):
        outcome.plot(max_outcomes=0)
