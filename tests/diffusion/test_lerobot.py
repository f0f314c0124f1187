"""
LeRobot's own DiffusionPolicy, trained here on a ball like PointMaze's and then guided by a causal world model.

Needs the package ``lerobot`` (0.4); its imports ask for more than the policy does.
"""

import copy

import pytest
import torch as th

from sb3_causalgdp.causal import CausalGuidance, MaskedWorldModel, RewardTarget, TransitionVariables, discover
from sb3_causalgdp.diffusion import ActionUnits, GuidanceRule, GuidedScheduler
from sb3_causalgdp.losses import world_model_loss

pytest.importorskip("lerobot")
types = pytest.importorskip("lerobot.configs.types")
configuration = pytest.importorskip("lerobot.policies.diffusion.configuration_diffusion")
modeling = pytest.importorskip("lerobot.policies.diffusion.modeling_diffusion")
processor = pytest.importorskip("lerobot.policies.diffusion.processor_diffusion")

HORIZON, N_OBSERVATIONS, N_PLAYED = 8, 2, 4
N_EPISODES, LENGTH = 200, 24
STATE, GOAL = "observation.state", "observation.environment_state"


def moved(state, force):
    """PointMaze's ball on a plane without walls, a tenth of a second later: position in metres, velocity, force in newtons."""
    velocity = 0.95 * state[:, 2:] + 0.1 * force
    return th.cat([state[:, :2] + 0.1 * velocity, velocity], dim=1)


def recorded_episodes():
    """Balls that are driven to their goals: states, actions, shapes ``(episodes, length, .)``, and goals."""
    generator = th.Generator().manual_seed(0)
    goal = 6.0 * th.rand(N_EPISODES, 2, generator=generator) - 3.0
    state = th.cat([6.0 * th.rand(N_EPISODES, 2, generator=generator) - 3.0, th.zeros(N_EPISODES, 2)], dim=1)
    wander = th.zeros(N_EPISODES, 2)
    states, actions = [state], []
    for _ in range(LENGTH):
        wander = 0.7 * wander + th.randn(N_EPISODES, 2, generator=generator)
        actions.append((2.0 * (goal - state[:, :2]) - 2.0 * state[:, 2:] + wander).clamp(-10.0, 10.0))
        state = moved(state, actions[-1])
        states.append(state)
    return th.stack(states, dim=1), th.stack(actions, dim=1), goal


def statistics_of(values):
    values = values.flatten(0, -2)
    return {"min": values.amin(0), "max": values.amax(0), "mean": values.mean(0), "std": values.std(0)}


@pytest.fixture(scope="module")
def recorded():
    return recorded_episodes()


@pytest.fixture(scope="module")
def world_model(recorded):
    """What the ball does, as this package learns it; the reward is its velocity to the right."""
    th.manual_seed(0)
    states, actions, _ = recorded
    state, action, next_state = states[:, :-1].flatten(0, 1), actions.flatten(0, 1), states[:, 1:].flatten(0, 1)
    reward = next_state[:, 2]
    variables = TransitionVariables(("x", "y", "vx", "vy"), ("fx", "fy"))
    stacked = variables.stack(*(values.numpy() for values in (state, action, next_state, reward)))
    graph = discover("partial_r2", stacked, variables)
    model = MaskedWorldModel(4, 2, [64, 64])
    masks = (graph.state_to_state, graph.action_to_state, graph.state_to_reward, graph.action_to_reward)
    model.set_masks(*(th.as_tensor(mask, dtype=th.float32) for mask in masks))
    optimizer = th.optim.Adam(model.parameters(), lr=2e-3)
    for _ in range(400):
        rows = th.randint(len(state), (256,))
        batch = [values[rows] for values in (state, action, next_state, reward)]
        model.update_statistics(batch[0], batch[2], batch[3])
        loss = sum(world_model_loss(model, *batch, sample_masks=True))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return model


@pytest.fixture(scope="module", params=["MIN_MAX", "MEAN_STD"])
def trained(request, recorded):
    """The policy and LeRobot's processors, which normalise."""
    th.manual_seed(0)
    states, actions, goal = recorded
    bound = 1.0 if request.param == "MIN_MAX" else 3.0
    feature, kind = types.PolicyFeature, types.FeatureType
    mode = types.NormalizationMode[request.param]
    config = configuration.DiffusionConfig(
        input_features={STATE: feature(kind.STATE, (4,)), GOAL: feature(kind.ENV, (2,))},
        output_features={"action": feature(kind.ACTION, (2,))},
        normalization_mapping={"STATE": mode, "ENV": mode, "ACTION": mode},
        n_obs_steps=N_OBSERVATIONS,
        horizon=HORIZON,
        n_action_steps=N_PLAYED,
        down_dims=(32, 64),
        kernel_size=3,
        diffusion_step_embed_dim=32,
        noise_scheduler_type="DDIM",
        num_train_timesteps=50,
        num_inference_steps=10,
        clip_sample_range=bound,
        device="cpu",
    )
    statistics = {STATE: statistics_of(states), GOAL: statistics_of(goal), "action": statistics_of(actions)}
    before, after = processor.make_diffusion_pre_post_processors(config, statistics)
    policy = modeling.DiffusionPolicy(config)
    optimizer = th.optim.Adam(policy.parameters(), lr=1e-3)
    for _ in range(400):
        episode = th.randint(N_EPISODES, (64, 1))
        first = th.randint(LENGTH - HORIZON, (64, 1))
        batch = before(
            {
                STATE: states[episode, first + th.arange(N_OBSERVATIONS)],
                GOAL: goal[episode].expand(-1, N_OBSERVATIONS, -1),
                "action": actions[episode, first + th.arange(HORIZON)],
                "action_is_pad": th.zeros(64, HORIZON, dtype=th.bool),
            }
        )
        loss, _ = policy.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return policy.eval(), before, after, bound


@pytest.fixture
def policy(trained):
    return (copy.deepcopy(trained[0]), *trained[1:])


def situation(recorded, n=64):
    """Two observations after another, as LeRobot's queues get them."""
    states, _, goal = recorded
    return states[:n, 3], states[:n, 4], goal[:n]


def action_of(policy, before, after, situation, noise):
    """LeRobot's own loop: observations into the queue, a chunk of actions, its first."""
    earlier, now, goal = situation
    policy.reset()
    for state in (earlier, now):
        policy._queues["action"].clear()
        action = policy.select_action(before({STATE: state, GOAL: goal}), noise=noise)
    return after(action)


def wish_of(world_model, state, next_state):
    """The next state, a hundred times as sure as the world model is after so few updates."""
    return CausalGuidance(world_model, state, next_state, RewardTarget(th.tensor(0.0)), state_scale=100.0, outcome_scale=0.0)


def test_a_guided_policy_of_lerobot_brings_about_the_next_state_that_is_wished_for(policy, recorded, world_model):
    policy, before, after, bound = policy
    now = situation(recorded)
    noise = th.randn(64, HORIZON, 2, generator=th.Generator().manual_seed(1))
    plain = action_of(policy, before, after, now, noise)
    # The policy has learned where to go
    driven = 2.0 * (now[2] - now[1][:, :2]) - 2.0 * now[1][:, 2:]
    assert float(th.cosine_similarity(driven, plain).median()) > 0.7

    units = ActionUnits.from_unnormalizer(after, n_actions=2)
    scheduler = GuidedScheduler(policy.diffusion.noise_scheduler, position=N_OBSERVATIONS - 1, units=units, clip=bound)
    policy.diffusion.noise_scheduler = scheduler
    assert th.equal(action_of(policy, before, after, now, noise), plain)

    # Where two newtons more to the right would have led, and neither up nor down
    end, wished = moved(now[1], plain), moved(now[1], plain + th.tensor([2.0, 0.0]))
    scheduler.guidance = wish_of(world_model, now[1], wished)
    guided = action_of(policy, before, after, now, noise)
    within = plain.abs().amax(dim=1) < 5.0
    assert float(within.float().mean()) > 0.5
    # By the ball itself, and by the world model
    for outcome in (moved(now[1], guided), world_model.action_response(now[1], guided).next_state):
        off, off_before = (outcome - wished)[within], (end - wished)[within]
        assert float(off.norm(dim=1).mean()) < 0.2 * float(off_before.norm(dim=1).mean())


def test_a_reward_that_is_wished_for_is_earned_through_the_next_state(policy, recorded, world_model):
    policy, before, after, bound = policy
    now = situation(recorded)
    noise = th.randn(64, HORIZON, 2, generator=th.Generator().manual_seed(2))
    plain = action_of(policy, before, after, now, noise)
    velocity = moved(now[1], plain)[:, 2]
    wished = RewardTarget(velocity + 0.2)
    guidance = CausalGuidance(world_model, now[1], now[1], wished, state_scale=0.0, outcome_scale=1e3)
    units = ActionUnits.from_unnormalizer(after, n_actions=2)
    scheduler = GuidedScheduler(policy.diffusion.noise_scheduler, guidance, position=1, units=units, clip=bound)
    policy.diffusion.noise_scheduler = scheduler
    guided = action_of(policy, before, after, now, noise)
    within = plain.abs().amax(dim=1) < 5.0
    gained = (moved(now[1], guided)[:, 2] - velocity)[within]
    assert float(gained.mean()) == pytest.approx(0.2, abs=0.04)
    # The other force earns nothing, and the graph says so
    change = (guided - plain)[within].abs().mean(dim=0)
    assert float(change[1]) < 0.3 * float(change[0])


def test_with_the_networks_jacobian_the_chunk_moves_with_its_first_action(policy, recorded, world_model):
    policy, before, after, bound = policy
    now = tuple(part[:8] for part in situation(recorded))
    noise = th.randn(8, HORIZON, 2, generator=th.Generator().manual_seed(3))
    plain = action_of(policy, before, after, now, noise)
    condition = policy.diffusion._prepare_global_conditioning(
        {key: th.stack(list(policy._queues[key]), dim=1) for key in (STATE, GOAL)}
    )

    def network(sample, timestep):
        return policy.diffusion.unet(sample, timestep.expand(len(sample)), global_cond=condition)

    wish = wish_of(world_model, now[1], moved(now[1], plain + th.tensor([2.0, 0.0])))
    units = ActionUnits.from_unnormalizer(after, n_actions=2)
    chunks = []
    for guidance in (None, wish):
        rule = GuidanceRule("posterior", "tweedie")
        policy.diffusion.noise_scheduler = GuidedScheduler(
            trained_scheduler(policy), guidance, rule, model=network, position=1, units=units, clip=bound
        )
        with th.no_grad():
            chunks.append(after(policy.diffusion.conditional_sample(8, global_cond=condition, noise=noise)))
    gained = (chunks[1] - chunks[0])[:, 1:5, 0].mean(dim=0)
    assert float(gained[0]) == pytest.approx(2.0, abs=0.7)
    # The wander of the demonstrations lasts for some steps, by .7 each
    assert float(gained[1]) > 0.3, gained


def trained_scheduler(policy):
    """The policy's own, with or without a guidance around it."""
    scheduler = policy.diffusion.noise_scheduler
    return getattr(scheduler, "scheduler", scheduler)
