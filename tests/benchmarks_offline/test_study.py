import gymnasium as gym
import numpy as np
import pytest

from benchmarks.offline.data import ensure_dataset, transitions
from benchmarks.offline.methods import CAUSALGDP_METHODS, D3RLPY_METHODS, METHODS, CausalGDPLearner, Planner, make_learner
from benchmarks.offline.run import main
from benchmarks.offline.study import SELECTION_SEED, TEST_SEED, Evaluation, train
from sb3_causalgdp.offline.scores import normalized_score

pytest.importorskip("mujoco")
pytest.importorskip("minari")

TASK, STEPS = "maze2d-umaze", 1_500
TINY = {"policy_kwargs": {"net_arch": [8], "world_model_net_arch": [8]}, "batch_size": 16}
# An episode has 300 steps, and each asks the policy
QUICK = {**TINY, "n_action_candidates": 1, "diffusion_steps": 2}


@pytest.fixture(autouse=True, scope="module")
def dataset(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        yield ensure_dataset(TASK, STEPS)


def tiny_learner(method, seed=0):
    return make_learner(method, TASK, seed, ensure_dataset(TASK, STEPS), TINY)


def test_a_run_reports_its_evaluations_and_its_last_and_best_checkpoint(tmp_path):
    rows = train(TASK, "no_guidance", 0, tmp_path, 6, STEPS, 3, selection_episodes=2, episodes=3, overrides=QUICK)
    assert [(row["checkpoint"], row["updates"]) for row in rows[:-1]] == [
        ("training", 2), ("training", 4), ("training", 6), ("last", 6)]  # fmt: skip
    assert [row["episodes"] for row in rows] == [2, 2, 2, 3, 3]
    chosen = max(rows[:3], key=lambda row: (row["score"], row["updates"]))
    assert rows[-1]["checkpoint"] == "best" and rows[-1]["updates"] == chosen["updates"]
    for row in rows:
        assert row["score"] == pytest.approx(normalized_score(TASK, row["mean_return"]).mean, abs=0.01)


def test_an_interrupted_run_makes_only_the_updates_that_are_missing(tmp_path, monkeypatch):
    done, real = [], CausalGDPLearner.train

    def interrupted(learner, n_updates):
        if len(done) == 1:
            raise KeyboardInterrupt
        done.append(n_updates)
        real(learner, n_updates)

    arguments = (TASK, "no_guidance", 0, tmp_path, 6, STEPS, 2, 1, 1, QUICK)
    monkeypatch.setattr(CausalGDPLearner, "train", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(*arguments)
    learners = []
    monkeypatch.setattr(
        CausalGDPLearner, "train", lambda learner, n: (learners.append(learner), done.append(n), real(learner, n))
    )
    rows = train(*arguments)
    assert done == [3, 3] and learners[0].model.n_pretrain_steps == 6
    assert [row["updates"] for row in rows[:2]] == [3, 6]


def test_all_runs_are_evaluated_from_the_same_starts_which_differ_from_those_of_the_selection():
    starts = []
    for seed in (TEST_SEED, TEST_SEED, SELECTION_SEED):
        evaluation = Evaluation(TASK, 3, seed)
        evaluation.envs.seed(seed)
        starts.append(evaluation.envs.reset())
    assert np.array_equal(starts[0], starts[1]) and not np.isin(starts[2], starts[0]).any()


def test_returns_are_those_of_the_registered_environment():
    planner, expected = Planner(TASK), []
    for seed in (5, 6):
        env = gym.make("sb3_causalgdp/Maze2d-UMaze-v1")
        (observation, _), total, truncated = env.reset(seed=seed), 0.0, False
        while not truncated:
            observation, reward, _, truncated, _ = env.step(planner.predict(observation[None])[0])
            total += reward
        expected.append(total)
    assert Evaluation(TASK, 2, 5).returns(planner).tolist() == expected


@pytest.mark.parametrize("method", [method for method in CAUSALGDP_METHODS if method != "direct_lingam"])
def test_a_restored_method_acts_as_the_saved_one_and_learns_on(method, tmp_path):
    learner, restored = tiny_learner(method), tiny_learner(method, seed=1)
    learner.train(2)
    learner.save(tmp_path / "checkpoint-2")
    observations = transitions(learner.dataset_id)["observations"][:50].astype(np.float64)
    restored.load(tmp_path / "checkpoint-2", 2)
    if not learner.plays_samples:
        assert np.array_equal(learner.predict(observations), restored.predict(observations))
    assert learner.model.policy.is_guided == restored.model.policy.is_guided == (method not in ("no_guidance", "bc"))
    before = learner.predict(observations)
    restored.train(1)
    assert not np.array_equal(before, restored.predict(observations))


def test_without_masks_every_edge_is_open_and_the_policy_is_guided():
    learner = tiny_learner("open")
    learner.train(1)
    assert (learner.model.causal_graph().masks == 1.0).all() and learner.model.policy.is_guided


def test_the_ablations_have_other_graphs_than_the_default():
    masks = {}
    for method in ("causalgdp", "notears", "perturbed"):
        learner = tiny_learner(method)
        learner.train(1)
        masks[method] = learner.model.causal_graph().masks
    assert all(np.abs(masks[method] - masks["causalgdp"]).max() > 0.1 for method in ("notears", "perturbed"))


def test_behaviour_cloning_plays_samples_and_ignores_the_critics():
    learner = tiny_learner("bc")
    observations = np.tile([1.0, 1.0, 0.0, 0.0], (200, 1))
    actions = learner.predict(observations)
    assert (actions.std(axis=0) > 0.05).all()
    assert learner.model.eta == 0.0 and learner.model.n_action_candidates == 1 and learner.model.exploration_noise == 0.0


@pytest.mark.parametrize("method", ["td3_bc", "iql", "cql"])
def test_the_peers_learn_on_the_same_data_and_can_be_restored(method, tmp_path):
    pytest.importorskip("d3rlpy")
    dataset_id = ensure_dataset(TASK, STEPS)
    tiny = {"net_arch": [8], "batch_size": 16}
    learner, restored = (make_learner(method, TASK, seed, dataset_id, tiny) for seed in (0, 1))
    learner.train(4)
    learner.save(tmp_path / "checkpoint-4")
    observations = learner.data["observations"][:50]
    assert not np.allclose(learner.predict(observations), restored.predict(observations))
    restored.load(tmp_path / "checkpoint-4", 4)
    assert np.array_equal(learner.predict(observations), restored.predict(observations))
    assert restored.algorithm.grad_step == 4


def test_the_arrays_hold_every_transition_of_the_dataset():
    arrays = transitions(ensure_dataset(TASK, STEPS))
    assert {name: len(values) for name, values in arrays.items()} == dict.fromkeys(arrays, STEPS)
    same_episode = np.arange(STEPS - 1) % 300 != 299
    following = (arrays["next_observations"][:-1] == arrays["observations"][1:]).all(axis=1)
    assert following[same_episode].all() and not arrays["terminations"].any()


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="method must be one of causalgdp"):
        make_learner("sac", TASK, 0, ensure_dataset(TASK, STEPS))


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--methods", "sac"], "invalid choice: 'sac'"),
        (["--updates", "0"], "--updates must be at least 1"),
        (["--updates", "5", "--evaluations", "6"], "--evaluations must be at most --updates"),
        (["--peer-python", "/no/such/python"], "--peer-python cannot be run"),
    ],
)
def test_the_command_line_says_what_is_wrong(arguments, message, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["run", *arguments])
    with pytest.raises(SystemExit) as error:
        main()
    assert error.value.code == 2 and message in capsys.readouterr().err


def test_methods_are_those_of_the_command_line():
    assert len(set(METHODS)) == len(METHODS) == len(CAUSALGDP_METHODS) + len(D3RLPY_METHODS) + 1
