"""The page about a run: complete, in one file, and honest about what the run lacks."""

import base64
import html.parser
import io
import json
import os
import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import chromium
import numpy as np
import pytest
import yaml
from stable_baselines3.common.save_util import data_to_json

pytest.importorskip("rl_zoo3")
pytest.importorskip("matplotlib")
from PIL import Image

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.causal import CausalGraph
from sb3_causalgdp.zoo.graph_sections import graph_section
from sb3_causalgdp.zoo.run_folder import RunFolder, find_runs

SECTIONS = [
    "Summary",
    "Learning curve",
    "Causal graph",
    "History of the graph",
    "Effects of the actions",
    "Guidance along the denoising chain",
    "Evaluation",
    "Hyperparameters",
    "Versions",
    "Command",
]
VOID = {"meta", "img", "br", "link", "hr", "input"}


class Page(html.parser.HTMLParser):
    """Sections with their text, pictures and tables; closes what it opens, in order."""

    def __init__(self, path):
        super().__init__()
        self.open, self.tags, self.loads, self.sections, self.pictures, self.links = [], set(), [], {}, {}, []
        self.section = None
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.tags.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        if tag == "section":
            self.section = attributes["id"]
            self.sections[self.section] = ""
            self.pictures[self.section] = []
        if tag == "img":
            assert attributes["alt"]
            self.pictures[self.section].append(attributes["src"])
        if tag == "a":
            self.links.append(attributes["href"])
        self.loads += [attributes[name] for name in ("src", "srcset", "data", "action", "background") if name in attributes]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.section is not None:
            self.sections[self.section] += f"{' '.join(data.split())} "

    def text(self, title):
        return self.sections[title.lower().replace(" ", "-")]

    def images(self, title):
        sources = self.pictures[title.lower().replace(" ", "-")]
        return [Image.open(io.BytesIO(base64.b64decode(source.removeprefix("data:image/png;base64,")))) for source in sources]


@pytest.fixture(scope="module")
def trained(zoo, tiny, tmp_path_factory):
    """300 steps on Pendulum in episodes of 50, with two graphs."""
    folder = tmp_path_factory.mktemp("trained")
    before = os.getcwd()
    os.chdir(folder)
    try:
        zoo(
            *("train", "--algo", "causalgdp", "--env", "Pendulum-v1", "-f", "logs", "-n", 300, "--save-replay-buffer"),
            *("--eval-freq", 150, "--eval-episodes", 2, "--save-freq", 250, "--env-kwargs", "max_episode_steps:50"),
            *(*tiny, "learning_starts:240", "causal_refresh_freq:240"),
        )
    finally:
        os.chdir(before)
    return folder / "logs" / "causalgdp" / "Pendulum-v1_1"


@pytest.fixture
def run(trained, folder):
    copy = folder / "logs" / "causalgdp" / trained.name
    shutil.copytree(trained, copy)
    return copy


@pytest.fixture(scope="module")
def full_page(zoo, trained, tmp_path_factory):
    """The page of a run that lacks nothing, with a graph that changed."""
    folder = tmp_path_factory.mktemp("full")
    shutil.copytree(trained, folder / "run_1")
    add_history(folder / "run_1" / "Pendulum-v1.zip")
    path = folder / "pages" / "page.html"
    zoo("report", folder / "run_1", "-o", path, "--episodes", 2, "--device", "cpu")
    page = Page(path)
    page.path = path
    return page


def add_history(path, n_edges=1):
    """An earlier graph that differs in some edges."""
    from sb3_causalgdp import CausalGDP

    model = CausalGDP.load(path, device="cpu")
    graph = model.causal_graph()
    masks = graph.masks.copy()
    masks.flat[:n_edges] = 1.0 - masks.flat[:n_edges].round()
    model.causal_graph_history = [replace(graph, masks=masks, num_timesteps=120), graph]
    model.save(path, include=["causal_graph_history"])


def test_the_page_is_one_file_with_every_section(full_page):
    assert list(full_page.sections) == [title.lower().replace(" ", "-") for title in SECTIONS]
    assert full_page.links == [f"#{section}" for section in full_page.sections]
    assert not full_page.tags & {"script", "link", "iframe", "object", "embed", "video", "form", "base"}
    assert all(source.startswith("data:image/png;base64,") for source in full_page.loads)


def test_its_style_loads_nothing_and_knows_light_and_dark(full_page):
    text = full_page.source
    assert not [loads for loads in ("url(", "@import", "http://", "https://") if loads in text]
    assert "prefers-color-scheme: dark" in text and 'name="color-scheme" content="light dark"' in text


def test_its_pictures_decode_and_show_something(full_page):
    counts = {title: len(full_page.images(title)) for title in SECTIONS}
    expected = {"Learning curve": 1, "Causal graph": 2, "History of the graph": 1, "Effects of the actions": 1}
    assert counts == {**dict.fromkeys(SECTIONS, 0), **expected, "Guidance along the denoising chain": 1}
    for title in SECTIONS:
        for image in full_page.images(title):
            assert image.format == "PNG" and np.asarray(image.convert("L")).std() > 5.0


def test_a_browser_shows_all_of_it_and_complains_of_nothing(full_page, tmp_path):
    pytest.importorskip("PyQt6.QtWebEngineWidgets")
    surroundings = {"QT_QPA_PLATFORM": "offscreen", "QTWEBENGINE_CHROMIUM_FLAGS": "--no-sandbox --disable-gpu"}
    done = subprocess.run(
        [sys.executable, Path(__file__).with_name("browser.py"), full_page.path, tmp_path / "page.png"],
        env={**os.environ, **surroundings},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout.splitlines()[-1])
    assert "Pendulum-v1" in facts["title"]
    assert len(facts["pictures"]) == 6 and all(natural > 0 and 0 < shown <= 1200 for natural, shown in facts["pictures"])
    assert facts["links"] == [True] * len(SECTIONS) and facts["visible"] == [True] * len(SECTIONS)
    assert facts["overflow"] <= 0 and facts["complaints"] == []
    assert np.asarray(Image.open(tmp_path / "page.png").convert("L")).std() > 5.0


@pytest.mark.skipif(chromium.find() is None, reason="there is no Chromium")
def test_chromium_shows_all_of_it_loads_nothing_and_complains_of_nothing(full_page, tmp_path):
    with chromium.browser(tmp_path / "profile") as browser:
        browser.open(full_page.path.as_uri())
        text = browser.wait_for("CausalGDP on Pendulum-v1", *SECTIONS, "6 episodes", "opened (1): cos angle -> cos angle'")
        assert browser.evaluate("document.title").startswith("CausalGDP on Pendulum-v1")
        pictures = browser.evaluate(chromium.PICTURES)
        assert len(pictures) == 6 and all(natural > 0 and 0 < shown <= 1200 for _, natural, shown in pictures)
        assert browser.evaluate(chromium.OVERFLOW) <= 0
        # What is folded opens with a click
        names = ("cos angle", "sin angle", "vel angle", "torque")
        assert "strongest of" in text and not any(f"{name} reward" in text for name in names)
        browser.evaluate("document.querySelector('#causal-graph summary').click()")
        browser.wait_for("cause effect mask strength", *names)
        browser.screenshot(tmp_path / "page.png")
        assert np.asarray(Image.open(tmp_path / "page.png").convert("L")).std() > 5.0
        assert {request for request in browser.requests if not request.startswith("data:")} == {full_page.path.as_uri()}
        assert browser.complaints == []
        browser.open(full_page.path.as_uri(), width=400)
        browser.wait_for(*SECTIONS)
        assert browser.evaluate(chromium.OVERFLOW) <= 0


def test_it_says_what_the_run_was(full_page):
    summary = full_page.text("Summary")
    assert "Pendulum-v1.zip (final), 300 environment steps" in summary
    assert "6 episodes" in summary and "from 239 transitions" in summary
    assert "Found after 240 environment steps by partial_r2 from 239 transitions" in full_page.text("Causal graph")
    assert "What can matter for any future reward: 4 of 4 variables" in full_page.text("Causal graph")
    assert "what changed from step 120 to step 240" in full_page.text("History of the graph")
    assert "opened (1): cos angle -> cos angle'" in full_page.text("History of the graph")
    assert "300 transitions drawn from replay_buffer.pkl" in full_page.text("Effects of the actions")
    assert "Deterministic policy, 2 episodes" in full_page.text("Evaluation")
    hyperparameters = full_page.text("Hyperparameters")
    assert "learning_starts 240 " in hyperparameters and "diffusion_steps 2 5 " in hyperparameters
    assert "buffer_size 1000 1000000 " in hyperparameters  # of the training, not that of the loaded model
    assert "Stable-Baselines3" in full_page.text("Versions") and "rl_zoo3" in full_page.text("Versions")


def test_it_shows_the_exact_command(full_page, trained):
    assert full_page.text("Command").split() == ["Command", *(trained / "Pendulum-v1" / "command.txt").read_text().split()]


def test_it_shows_what_was_installed_where_it_was_trained(zoo, run):
    path = run / "Pendulum-v1" / "versions.yml"
    versions = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump({**versions, "rl_zoo3": "2.0.0", "mujoco": 3.1}))
    zoo("report", run, "--load-best", "--episodes", 0)
    page = Page(run / "report.html")
    assert f"rl_zoo3 2.0.0 {versions['rl_zoo3']} " in page.text("Versions")
    assert f"mujoco 3.1 {versions['mujoco']} " in page.text("Versions")


def test_the_history_is_that_of_the_run_whichever_model_is_shown(zoo, run):
    add_history(run / "Pendulum-v1.zip")
    zoo("report", run, "--load-best", "--episodes", 0)
    page = Page(run / "report.html")
    assert "best_model.zip (best)" in page.text("Summary")
    assert "2 graphs, from the model at the end of the training" in page.text("History of the graph")


def test_evaluations_stand_on_the_page(full_page, trained):
    results = np.load(trained / "evaluations.npz")["results"]
    assert f"{results[-1].mean():.1f} ± {results[-1].std():.1f} at 300 steps" in full_page.text("Summary")


def test_many_changes_of_the_graph_are_folded(zoo, run):
    add_history(run / "Pendulum-v1.zip", n_edges=13)
    zoo("report", run, "--episodes", 0)
    page = Page(run / "report.html")
    history = page.source.split('id="history-of-the-graph"')[1].split("</section>")[0]
    assert "<details><summary>Edges: " in history and history.count("<pre>") == 1
    assert history.index("<details>") < history.index("<pre>") < history.index("</details>")


def test_few_changes_of_the_graph_are_shown(full_page):
    history = full_page.source.split('id="history-of-the-graph"')[1].split("</section>")[0]
    assert "<details>" not in history and "opened (1)" in history


def test_success_rates_stand_on_the_page(zoo, run):
    with np.load(run / "evaluations.npz") as file:
        evaluations = dict(file)
    np.savez(run / "evaluations.npz", **evaluations, successes=[[True, False], [True, True]])
    zoo("report", run, "--episodes", 0)
    assert "at 300 steps, success rate 100%" in Page(run / "report.html").text("Summary")


def test_of_several_runs_those_with_a_model_get_a_page(zoo, run, capsys):
    other = run.with_name("Hopper-v5_1")
    other.mkdir()
    (other / "0.monitor.csv").touch()
    (run / "replay_buffer.pkl").unlink()
    zoo("report", run.parent, "--episodes", 1)
    skipped, wrote = capsys.readouterr().out.strip().splitlines()[-2:]
    assert skipped.startswith(f"Skipped {other}: there is no model yet.") and wrote == f"Wrote {run / 'report.html'}"
    page = Page(run / "report.html")
    # Without a replay buffer the policy plays
    assert "50 steps of the episodes that the model played" in page.text("Effects of the actions")
    assert len(page.images("Effects of the actions")) == 1
    # The checkpoint at 250 steps and the model hold the same graph
    assert "There is none: one graph is known." in page.text("History of the graph")


def test_what_is_missing_is_said(zoo, run):
    for path in [*run.glob("*.monitor.csv"), run / "evaluations.npz", run / "replay_buffer.pkl", run / "Pendulum-v1.zip"]:
        path.unlink()
    shutil.rmtree(run / "Pendulum-v1")
    zoo("report", run)
    page = Page(run / "report.html")
    assert "best_model.zip (best)" in page.text("Summary")
    assert "No training episode has ended" in page.text("Learning curve") and page.images("Learning curve") == []
    assert "Not computed: there are no observations" in page.text("Effects of the actions")
    assert "Not played: the run has no args.yml" in page.text("Evaluation")
    assert "The run has no config.yml" in page.text("Hyperparameters")
    assert "Not recorded" in page.text("Command")


def emptied(path):
    path.write_bytes(b"")


def cut(path):
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def mixed_up(path):
    path.write_bytes(b"[1, 2\n\x80\xff: }")


@pytest.mark.parametrize("damage", [emptied, cut, mixed_up])
def test_files_that_are_damaged_are_named_where_they_are_missed_and_the_rest_is_shown(zoo, run, damage):
    settings = run / "Pendulum-v1"
    monitor = next(run.glob("*.monitor.csv"))
    for path in (
        run / "evaluations.npz",
        run / "replay_buffer.pkl",
        run / "rl_model_250_steps.zip",
        settings / "versions.yml",
    ):
        damage(path)
    if damage is not cut:
        # Half of it may still be settings
        damage(settings / "config.yml")
        damage(monitor)
    zoo("report", run, "--episodes", 1)
    page = Page(run / "report.html")
    assert list(page.sections) == [title.lower().replace(" ", "-") for title in SECTIONS]
    said = "is left out, because it is empty, cut off, damaged or not trusted: "
    assert f"evaluations.npz {said}" in page.text("Learning curve")
    assert f"replay_buffer.pkl {said}" in page.text("Effects of the actions")
    assert f"rl_model_250_steps.zip {said}" in page.text("History of the graph")
    if damage is not cut:
        assert f"{monitor.name} {said}" in page.text("Learning curve") and "config.yml " in page.text("Hyperparameters")
        assert "versions.yml is " in page.text("Versions")
        assert "No training episode has ended" in page.text("Learning curve")
    else:
        assert "50 steps of the episodes that the model played" in page.text("Effects of the actions")
        assert len(page.images("Effects of the actions")) == 1
    assert "Pendulum-v1.zip (final), 300 environment steps" in page.text("Summary")
    assert len(page.images("Causal graph")) == 2


def test_rows_of_a_monitor_file_that_are_cut_are_left_out(run):
    episodes = RunFolder(run).training_episodes()
    path = next(run.glob("*.monitor.csv"))
    with path.open("a") as file:
        file.write("-12.5,5")
    run_folder = RunFolder(run)
    found = run_folder.training_episodes()
    np.testing.assert_array_equal(found.returns, episodes.returns)
    np.testing.assert_array_equal(found.steps, np.arange(50, 301, 50))
    np.testing.assert_allclose(found.seconds, episodes.seconds)
    assert run_folder.problems == {path.name: f"{path.name} is cut off or damaged: 1 of 7 rows are left out"}


def test_an_empty_monitor_file_beside_others_takes_none_with_it(run):
    (run / "1.monitor.csv").touch()
    run_folder = RunFolder(run)
    assert len(run_folder.training_episodes().returns) == 6 and list(run_folder.problems) == ["1.monitor.csv"]


def test_of_a_model_that_is_cut_off_the_newest_whole_one_takes_the_place(zoo, run):
    shutil.copy(run / "rl_model_250_steps.zip", run / "rl_model_280_steps.zip")
    cut(run / "Pendulum-v1.zip")
    for age, name in enumerate(("rl_model_280_steps.zip", "best_model.zip", "rl_model_250_steps.zip")):
        os.utime(run / name, (1e9 - age, 1e9 - age))
    zoo("report", run, "--episodes", 0)
    summary = Page(run / "report.html").text("Summary")
    assert (
        "Pendulum-v1.zip is left out, because it is empty" in summary
        and "rl_model_280_steps.zip (checkpoint), 250 env" in summary
    )
    cut(run / "rl_model_280_steps.zip")
    zoo("report", run, "--episodes", 0)
    assert "best_model.zip (best)" in Page(run / "report.html").text("Summary")


def test_an_environment_that_fails_while_it_is_played_is_no_reason_to_stop(zoo, run, monkeypatch):
    def step(self, action):
        raise ArithmeticError("broken arm.")

    monkeypatch.setattr("gymnasium.envs.classic_control.pendulum.PendulumEnv.step", step)
    zoo("report", run)
    page = Page(run / "report.html")
    assert "Not played: ArithmeticError: broken arm. " in page.text("Evaluation")
    assert len(page.images("Effects of the actions")) == 1


def test_an_environment_that_is_not_here_is_no_reason_to_stop(zoo, run):
    settings = run / "Pendulum-v1" / "args.yml"
    settings.write_text(settings.read_text().replace("- Pendulum-v1", "- Elsewhere-v0"))
    zoo("report", run)
    page = Page(run / "report.html")
    assert "the environment Elsewhere-v0 cannot be made here: NameNotFound" in page.text("Evaluation")
    assert len(page.images("Effects of the actions")) == 1


def test_graphs_are_read_from_checkpoints_each_once(run):
    run_folder = RunFolder(run, trusted=True)
    (graph,) = run_folder.checkpoint_graphs()
    assert graph.num_timesteps == 240
    # An older one, found at 120 steps
    with zipfile.ZipFile(run / "rl_model_130_steps.zip", "w") as archive:
        archive.writestr("data", data_to_json({"_causal_graph": replace(graph, num_timesteps=120)}))
    shutil.copy(run / "rl_model_250_steps.zip", run / "rl_model_300_steps.zip")
    assert [one.num_timesteps for one in run_folder.checkpoint_graphs()] == [120, 240]
    assert [steps for steps, _ in run_folder.checkpoints()] == [130, 250, 300]
    assert run_folder.models()["checkpoint"].name == "rl_model_300_steps.zip"


def test_of_an_algorithms_folder_the_latest_run_of_each_environment(run):
    folder = run.parent
    hopper = "Hopper-v5_3_0f8fad5b-d9cb-469f-a165-70867728950e"
    for name in ("Pendulum-v1_2", "Pendulum-v1_10", hopper):
        (folder / name).mkdir()
        (folder / name / "0.monitor.csv").touch()
    (folder / "Pendulum-v1_11").mkdir()  # without anything in it
    # The latest without a model only where no run has one
    assert [one.path.name for one in find_runs(folder)] == [hopper, run.name]
    shutil.copy(run / "best_model.zip", folder / "Pendulum-v1_2")
    assert [one.path.name for one in find_runs(folder)] == [hopper, "Pendulum-v1_2"]
    for path in folder.glob("*/*.zip"):
        path.unlink()
    assert [one.path.name for one in find_runs(folder)] == [hopper, "Pendulum-v1_10"]


@pytest.fixture
def fails(zoo, capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as raised:
            zoo("report", *arguments)
        assert raised.value.code == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        return line.removeprefix("causalgdp-zoo report: error: ")

    return run


def test_folders_without_a_run(fails, folder):
    assert fails("nowhere").startswith("nowhere: there is no such folder. Give the folder of a run, like logs/causalgdp/")
    assert fails(folder).startswith(f"{folder}: there is no run in it.")


def test_runs_without_a_model(fails, run):
    for path in run.glob("*.zip"):
        path.unlink()
    assert fails(run) == (
        f"{run}: there is no model yet. Wait for the end of the training, or train with --save-freq or --eval-freq"
    )
    assert "there is no best_model.zip" in fails(run, "--load-best")
    (run / "Pendulum-v1.zip").write_bytes(b"PK")
    assert f"{run / 'Pendulum-v1.zip'} cannot be loaded: " in fails(run)
    assert not (run / "report.html").exists()


def test_runs_of_another_algorithm(fails, run):
    settings = run / "Pendulum-v1" / "args.yml"
    settings.write_text(settings.read_text().replace("- causalgdp", "- sac"))
    assert fails(run) == f"{run} is a run of sac, the page is about causalgdp: plot_train plots its returns"


def test_one_page_is_about_one_run(fails, run):
    shutil.copytree(run, run.with_name("Hopper-v5_1"))
    assert "-o is for one run, but" in fails(run.parent, "-o", "page.html")
    assert fails(run, "--episodes", -1) == "--episodes must be at least 0, got -1"


def test_it_says_what_is_hidden_from_the_policy():
    model = CausalGDP("MlpPolicy", "Pendulum-v1", causal_abstraction={"patience": 1}, device="cpu")
    masks = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 1, 0]], dtype=float)
    graph = CausalGraph(model.transition_variables, masks, np.zeros_like(masks), method="by hand", n_samples=1000)
    model.set_causal_graph(graph)
    model.judge_relevance(graph)
    section = graph_section(model)
    assert "Hidden from actor and critics: cos angle, sin angle." in section.remarks
    shown = {row[0]: row[-1] for row in section.tables[-1].rows}
    assert shown == {"cos angle": "hidden", "sin angle": "hidden", "vel angle": "shown", "torque": "shown"}
