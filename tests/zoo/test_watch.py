"""The page that follows a training: what a person sees in a browser, and what files do that are missing, cut or new."""

import asyncio
import os
import queue
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request

import chromium
import numpy as np
import pytest

pytest.importorskip("rl_zoo3")
pytest.importorskip("matplotlib")
pytest.importorskip("bokeh", reason="the extra watch is not installed")
from PIL import Image

from sb3_causalgdp.zoo import watch_folder, watch_player
from sb3_causalgdp.zoo.algorithm import SetupError
from sb3_causalgdp.zoo.parts import Section
from sb3_causalgdp.zoo.run_folder import RunFolder, run_folders
from sb3_causalgdp.zoo.watch import make_server, names_of, url_of
from sb3_causalgdp.zoo.watch_folder import WatchedFolder
from sb3_causalgdp.zoo.watch_player import Player, Request, sections_of_play

NAMES = ("cos angle", "sin angle", "vel angle", "torque", "reward")
needs_chromium = pytest.mark.skipif(chromium.find() is None, reason="there is no Chromium")


@pytest.fixture
def run(trained_run, folder):
    """A copy of a training of 300 steps that has not ended: its graphs are of 100 and 200 steps."""
    copy = folder / "logs" / "causalgdp" / trained_run.name
    shutil.copytree(trained_run, copy)
    (copy / "Pendulum-v1.zip").rename(folder / "final.zip")
    # Which evaluation was the best depends on rounding
    shutil.copy(copy / "rl_model_110_steps.zip", copy / "best_model.zip")
    return copy


@pytest.fixture(scope="module")
def trained_run(zoo, tiny, tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    before = os.getcwd()
    os.chdir(folder)
    try:
        zoo(
            *("train", "--env", "Pendulum-v1", "-f", "logs", "-n", 300, "--env-kwargs", "max_episode_steps:50"),
            *("--eval-freq", 150, "--eval-episodes", 1, "--save-freq", 110),
            *(*tiny, "learning_starts:90", "callback:" + CALLBACK),
        )
    finally:
        os.chdir(before)
    return folder / "logs" / "causalgdp" / "Pendulum-v1_1"


# Graphs from fewer transitions than are asked for by default
CALLBACK = "{'sb3_causalgdp.CausalWorldModelCallback': dict(refresh_freq=100, min_transitions=90)}"


def text_of(html):
    return " ".join(re.sub("<[^>]*>", " ", html).split())


def says(watched, *arguments):
    """The sections without their tags, by their ids."""
    return {name: text_of(html) for name, html in watched.look(*arguments).sections.items()}


@pytest.fixture
def watched(folder):
    watched = WatchedFolder(folder / "logs", plays=False, player=Player(niceness=0))
    yield watched
    watched.close()


# What is read ---------------------------------------------------------------------------------------------------------


def test_a_folder_that_is_not_there_yet_is_waited_for(watched, folder, trained_run):
    view = watched.look()
    assert view.run is None and f"There is no run in {folder / 'logs'} yet" in text_of(view.sections["summary"])
    (folder / "logs" / "causalgdp").mkdir(parents=True)
    assert watched.look().run is None
    shutil.copytree(trained_run, folder / "logs" / "causalgdp" / "Pendulum-v1_1")
    assert watched.look().run == "causalgdp/Pendulum-v1_1"


def test_a_training_that_has_just_begun(watched, run):
    for path in [*run.glob("*.zip"), *run.glob("*.npz"), *run.glob("*.csv")]:
        path.unlink()
    (run / "0.monitor.csv").write_text('#{"t_start": 1.0, "env_id": "Pendulum-v1"}\nr,l,t\n')
    said = says(watched)
    assert "Training runs Steps 0 of 300 (0%)" in said["summary"]
    assert "No training episode has ended" in said["learning-curve"]
    assert "None is known yet. Checkpoints (--save-freq)" in said["causal-graph"]


def test_it_shows_the_newest_graph_and_older_ones_with_what_changed(watched, run):
    view = watched.look()
    assert view.moments == ("after 100 steps", "after 200 steps")
    said = says(watched)
    assert said["causal-graph"].startswith("Causal graph Graph 2 of 2: ") and "since the graph before" in said["causal-graph"]
    assert all(name in said["causal-graph"] for name in NAMES)
    assert "Graph 1 of 2: " in says(watched, view.run, 0)["causal-graph"]
    assert "2 graphs, from the checkpoints" in said["history-of-the-graph"]


def test_it_follows_files_that_grow(watched, run):
    shutil.copy(run / "rl_model_110_steps.zip", run.parent / "one.zip")
    (run / "rl_model_220_steps.zip").unlink()
    (run / "best_model.zip").unlink()
    before = watched.look()
    assert before.moments == ("after 100 steps",) and watched.look().sections == before.sections
    with next(run.glob("*.monitor.csv")).open("a") as file:
        file.write("-111.5,700,99.0\n")
    said = says(watched)
    assert "Steps 1,000 of 300 (100%)" in said["summary"]
    assert watched.look().sections["learning-curve"] != before.sections["learning-curve"]
    shutil.move(run.parent.parent.parent / "final.zip", run / "Pendulum-v1.zip")
    after = watched.look()
    assert "finished" in text_of(after.sections["summary"]) and len(after.moments) == 3


def test_files_that_are_half_written_are_named_and_the_rest_is_shown(watched, run):
    for name in ("rl_model_220_steps.zip", "evaluations.npz"):
        content = (run / name).read_bytes()
        (run / name).write_bytes(content[: len(content) // 2])
    with next(run.glob("*.monitor.csv")).open("a") as file:
        file.write("-12.5,5")
    (run / "best_model.zip").write_bytes(b"")
    view, said = watched.look(), says(watched)
    assert view.moments == ("after 100 steps",)
    assert "evaluations.npz is left out" in said["learning-curve"] and "1 of 7 rows are left out" in said["learning-curve"]
    assert "<img" in view.sections["learning-curve"] and "<img" in view.sections["causal-graph"]
    assert "rl_model_220_steps.zip is left out" in said["history-of-the-graph"]
    (run / "Pendulum-v1" / "args.yml").write_text("[1, 2\n: }")
    (run / "Pendulum-v1" / "config.yml").write_text("")
    assert "args.yml is left out" in says(watched)["summary"]


def test_of_several_runs_the_one_that_changed_last_comes_first(watched, run):
    other = run.with_name("Hopper-v5_3")
    shutil.copytree(run, other)
    for age, folder in ((0, run), (100, other)):
        for path in folder.glob("*"):
            os.utime(path, (1e9 - age, 1e9 - age))
    view = watched.look()
    assert view.runs == ("causalgdp/Pendulum-v1_1", "causalgdp/Hopper-v5_3") and view.run == view.runs[0]
    assert watched.look(view.runs[1]).run == view.runs[1] and watched.look("gone").run == view.runs[0]
    assert "nothing was written for" in says(watched)["summary"]
    assert run_folders(run) == [run] and run_folders(run.parent) == [run, other]
    assert WatchedFolder(run, plays=False).look().run == run.name


def test_a_run_of_another_algorithm_has_a_curve(watched, run):
    settings = run / "Pendulum-v1" / "args.yml"
    settings.write_text(settings.read_text().replace("- causalgdp", "- sac"))
    assert "<img" in watched.look().sections["learning-curve"]
    (section,) = sections_of_play(Request(run, False, 0))
    assert "is a run of sac" in section.remarks[0]


def test_how_many_steps_are_wanted(run):
    assert RunFolder(run).wanted_steps == 300
    settings = run / "Pendulum-v1" / "args.yml"
    settings.write_text(re.sub(r"(n_timesteps\n    - )300", r"\1-1", settings.read_text()))
    assert RunFolder(run).wanted_steps == 10_000  # of config.yml
    (run / "Pendulum-v1" / "config.yml").write_text("n_timesteps: many")
    assert RunFolder(run).wanted_steps is None


# What plays -------------------------------------------------------------------------------------------------------------


def test_the_newest_model_plays_with_a_film(run):
    sections = {section.id: section for section in sections_of_play(Request(run, False, 0))}
    assert list(sections) == ["rollout", "effects-of-the-actions", "guidance-along-the-denoising-chain"]
    rollout = sections["rollout"]
    assert re.match(r"\w+\.zip \(\w+\), after \d+ steps: return -[\d.]+ in 50 steps, without", rollout.remarks[0])
    (film,) = rollout.pictures
    assert film.format == "webp" and len(sections["effects-of-the-actions"].pictures) == 1


def test_a_film_of_a_long_episode_keeps_to_its_length():
    class Environment:
        def render(self, mode):
            return np.zeros((40, 640, 3), dtype=np.uint8)

    film = watch_player.Film()
    for _ in range(1_000):
        film(Environment())
    assert watch_player.MOST_FRAMES / 2 < len(film.frames) <= watch_player.MOST_FRAMES
    assert film.frames[0].size == (320, 20) and film.problem is None


def test_an_environment_without_a_renderer_is_played_without_a_film(run, monkeypatch):
    def render(self):
        raise RuntimeError("no screen")

    monkeypatch.setattr("gymnasium.envs.classic_control.pendulum.PendulumEnv.render", render)
    rollout = sections_of_play(Request(run, False, 0))[0]
    assert "in 50 steps" in rollout.remarks[0] and rollout.remarks[1] == "No film: RuntimeError: no screen."


def test_a_run_that_would_run_code_is_not_played(run):
    settings = run / "Pendulum-v1" / "args.yml"
    settings.write_text(settings.read_text().replace("gym_packages\n    - []", "gym_packages\n    - [antigravity]"))
    assert "antigravity" in settings.read_text()
    assert "which could run code" in sections_of_play(Request(run, False, 0))[0].remarks[0]
    assert "antigravity" not in sys.modules


def ends(request):
    if request.seed == 1:
        os._exit(3)
    if request.seed == 2:
        raise ValueError("<b>odd</b>")
    return [Section("Rollout", [f"{request.path.name} in {os.getpid()}"])]


def test_a_renderer_that_ends_its_process_does_not_end_the_page(run):
    player = Player(ends, niceness=0)
    assert "the process that plays ended" in player.play(Request(run, False, 1))["rollout"]
    first = player.play(Request(run, False, 0))["rollout"]
    assert run.name in first and str(os.getpid()) not in first
    assert "ValueError: &lt;b&gt;odd&lt;/b&gt;" in player.play(Request(run, False, 2))["rollout"]
    assert player.play(Request(run, False, 0))["rollout"] == first
    process = player._process
    player.close()
    assert not process.is_alive()


class CountingPlayer(Player):
    def __init__(self):
        super().__init__()
        self.n_played = 0

    def play(self, request):
        self.n_played += 1
        time.sleep(0.05)
        return {"rollout": f"played {self.n_played}"}


def test_a_model_plays_once_and_a_new_one_when_its_time_has_come(run, monkeypatch):
    monkeypatch.setattr(watch_folder, "PLAYING_SHARE", 1e-4)
    player = CountingPlayer()
    watched = WatchedFolder(run.parent, player=player)
    assert "is playing" in says(watched)["rollout"]
    time.sleep(0.3)
    assert says(watched)["rollout"] == says(watched)["rollout"] == "played 1"
    shutil.copy(run / "rl_model_220_steps.zip", run / "rl_model_330_steps.zip")
    # Most of the time is without it
    assert says(watched)["rollout"] == "played 1" and player.n_played == 1
    watched._runs[run].may_play_at = time.monotonic()
    watched.look()
    time.sleep(0.3)
    assert says(watched)["rollout"] == "played 2"
    watched.close()


# What is served -------------------------------------------------------------------------------------------------------


@pytest.fixture
def fails(zoo, capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as raised:
            zoo("watch", *arguments)
        assert raised.value.code == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        return line.removeprefix("causalgdp-zoo watch: error: ")

    return run


def test_arguments_out_of_range(fails, folder):
    (folder / "file").touch()
    assert fails("file") == "file is a file: give a folder, like logs/causalgdp"
    assert fails("logs", "--refresh", 0) == "--refresh must be from 0.1 to 3600 seconds, got 0"
    assert fails("logs", "--port", 70_000) == "--port must be from 0 to 65535, got 70000"
    assert fails("logs", "--seed", -1) == "--seed must be at least 0, got -1"
    assert fails("logs", "--host", "::1").startswith("--host must be a name or an IPv4 address")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert fails("logs", "--port", port).startswith(f"cannot listen on --host localhost --port {port}: ")


def test_without_bokeh_the_command_that_installs_it_is_named(fails, folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "bokeh.server.server", None)
    assert fails("logs").endswith(": pip install bokeh")


def test_it_listens_on_this_machine_alone_unless_another_address_is_given(watched):
    server = make_server(watched, "localhost", 0, 1.0)
    listening = {entry.getsockname()[0] for entry in server._http._sockets.values()}
    server.stop()
    assert listening and listening <= {"127.0.0.1", "::1"}
    assert names_of("localhost") == names_of("127.0.0.1") == ["localhost", "127.0.0.1"]
    assert socket.gethostname() in names_of("0.0.0.0") and names_of("10.1.2.3")[0] == "10.1.2.3"
    assert url_of("0.0.0.0", 80) == f"http://{socket.gethostname()}:80/"
    with pytest.raises(SetupError, match=r"cannot listen on --host 203\.0\.113\.1"):
        make_server(watched, "203.0.113.1", 0, 1.0)


@pytest.fixture
def served(watched):
    """The address of a page that looks twice a second."""
    started = queue.Queue()

    def serve():
        # Bokeh's server belongs to the event loop of its thread
        asyncio.set_event_loop(asyncio.new_event_loop())
        server = make_server(watched, "localhost", 0, 0.5)
        server.start()
        started.put(server)
        server.io_loop.start()
        server.stop()

    thread = threading.Thread(target=serve)
    thread.start()
    server = started.get(timeout=60)
    yield url_of("localhost", server.port)
    server.io_loop.add_callback(server.io_loop.stop)
    thread.join()


def test_the_command_serves_the_page_until_it_is_asked_to_end(run):
    command = [sys.executable, "-m", "sb3_causalgdp.zoo", "watch", "logs", "--port", "0", "--no-play"]
    surroundings = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=surroundings)
    url = re.fullmatch(r"Watch logs at (http://localhost:\d+/) \(Ctrl-C ends it\)\n", process.stdout.readline())[1]
    try:
        assert "<title>CausalGDP in training</title>" in urllib.request.urlopen(url).read().decode()
    finally:
        # Not Ctrl-C's signal, which a process in a shell's background does not get
        process.terminate()
        rest, _ = process.communicate(timeout=60)
    assert rest == "" and process.returncode == 128 + signal.SIGTERM


def test_pages_of_others_get_no_answer(served):
    url = served
    page = urllib.request.urlopen(url).read().decode()
    token = re.search(r'"token":"([^"]+)"', page)[1]

    def upgrade(origin):
        host, port = re.match(r"http://([^:]+):(\d+)/", url).groups()
        lines = [
            *("GET /ws HTTP/1.1", f"Host: {host}:{port}", f"Origin: {origin}", "Connection: Upgrade", "Upgrade: websocket"),
            *("Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Version: 13"),
            f"Sec-WebSocket-Protocol: bokeh, {token}",
        ]
        with socket.create_connection((host, int(port))) as connection:
            connection.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
            return connection.recv(100).split()[1]

    assert upgrade(url.rstrip("/")) == b"101" and upgrade("http://example.org") == b"403"


@needs_chromium
def test_a_browser_shows_the_training_as_it_goes_on(served, run, folder, tmp_path):
    with chromium.browser(tmp_path / "profile") as browser:
        # A page that is opened before the training has begun
        shutil.move(run, folder / "later")
        browser.open(served)
        browser.wait_for("CausalGDP in training", f"There is no run in {folder / 'logs'} yet")
        shutil.move(folder / "later", run)
        text = browser.wait_for("Learning curve", "Graph 2 of 2", "Steps 300 of 300", *NAMES)
        assert "Training runs" in text and browser.evaluate("document.title") == "CausalGDP in training"
        pictures = dict((alt, (natural, shown)) for alt, natural, shown in browser.evaluate(chromium.PICTURES))
        assert len(pictures) == 4 and all(natural > 0 and 0 < shown <= 1200 for natural, shown in pictures.values())
        assert browser.evaluate(chromium.OVERFLOW) <= 0
        # The training goes on, and ends
        with next(run.glob("*.monitor.csv")).open("a") as file:
            file.write("-111.5,700,99.0\n")
        browser.wait_for("Steps 1,000 of 300")
        shutil.move(folder / "final.zip", run / "Pendulum-v1.zip")
        browser.wait_for("Training finished", "Graph 3 of 3")
        browser.screenshot(tmp_path / "page.png")
        assert np.asarray(Image.open(tmp_path / "page.png").convert("L")).std() > 5.0
        # Nothing but this server was asked, and nothing was wrong
        assert browser.complaints == []
        addresses = [request for request in browser.requests if not request.startswith("data:")]
        assert any(address.startswith("ws://localhost:") for address in addresses)
        assert all(re.sub("^ws", "http", address).startswith(served) for address in addresses)


@needs_chromium
def test_a_browser_shows_an_older_graph_another_run_and_the_film(served, watched, run, tmp_path):
    other = run.with_name("Other-v0_1")
    shutil.copytree(run, other)
    for path in other.glob("*"):
        os.utime(path, (1e9, 1e9))
    watched.plays = True
    with chromium.browser(tmp_path / "profile") as browser:
        browser.open(served)
        browser.wait_for(
            "Graph 2 of 2", "What the policy does in one episode.", "What the causal world model says", seconds=300
        )
        browser.evaluate("Bokeh.documents[0].get_model_by_name('graphs').value = 0")
        browser.evaluate("Bokeh.documents[0].get_model_by_name('graphs').value_throttled = 0")
        browser.wait_for("Graph 1 of 2: ")
        browser.evaluate("Bokeh.documents[0].get_model_by_name('runs').value = 'causalgdp/Other-v0_1'")
        browser.wait_for("nothing was written for", "Graph 2 of 2: ")
