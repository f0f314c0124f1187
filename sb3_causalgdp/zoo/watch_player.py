"""The newest model of a run plays, in a process of its own: rendering belongs to a main thread, and may end the process."""

import base64
import io
import multiprocessing
import os
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch as th
from PIL import Image
from stable_baselines3.common.vec_env import VecEnv

from sb3_causalgdp.zoo.algorithm import SetupError
from sb3_causalgdp.zoo.pages import section_html
from sb3_causalgdp.zoo.parts import Picture, Section, guarded
from sb3_causalgdp.zoo.played import Played, transitions_played
from sb3_causalgdp.zoo.playing import load_first_whole, make_environment, models_to_try, play
from sb3_causalgdp.zoo.report_sections import effects_section, guidance_section
from sb3_causalgdp.zoo.run_folder import RunFolder

MOST_STEPS = 1_000
MOST_FRAMES = 120
FRAME_WIDTH = 320
FRAME_MILLISECONDS = 60
NICENESS = 5


class Request(NamedTuple):
    """A run whose newest model is to play."""

    path: Path
    trusted: bool
    seed: int


# In the other process ---------------------------------------------------------------------------------------------------


class Film:
    """
    Pictures of an episode, evenly spaced however long it is.
    """

    def __init__(self) -> None:
        self.frames: list[Image.Image] = []
        self.problem: str | None = None
        self._n_steps = 0
        self._every = 1

    def __call__(self, environment: VecEnv) -> None:
        """
        :param environment: One that has just made a step
        """
        if self.problem is None and self._n_steps % self._every == 0:
            try:
                self._take(environment)
            except Exception as error:  # whatever a renderer raises, the episode goes on
                self.problem = f"{type(error).__name__}: {error}"
        self._n_steps += 1

    def _take(self, environment: VecEnv) -> None:
        pixels = environment.render(mode="rgb_array")
        if pixels is None:
            raise RuntimeError("the environment gives no picture")
        frame = Image.fromarray(np.asarray(pixels, dtype=np.uint8))
        if frame.width > FRAME_WIDTH:
            frame = frame.resize((FRAME_WIDTH, round(frame.height * FRAME_WIDTH / frame.width)))
        self.frames.append(frame)
        if len(self.frames) > MOST_FRAMES:
            self.frames = self.frames[::2]
            self._every *= 2

    def picture(self, caption: str) -> Picture:
        """
        :param caption: What it shows
        :return: The film as a picture that moves
        """
        data = io.BytesIO()
        first, *others = self.frames
        options = {"duration": FRAME_MILLISECONDS, "loop": 0, "quality": 60, "method": 0}
        first.save(data, format="WEBP", save_all=True, append_images=others, **options)
        return Picture(caption, base64.b64encode(data.getvalue()).decode(), first.width, "webp")


def sections_of_play(request: Request) -> list[Section]:
    """
    :param request: A run
    :return: What its newest model does: the film, effects of the actions, guidance
    """
    run = RunFolder(request.path, request.trusted)
    try:
        candidates = models_to_try(run, newest=True)
    except SetupError as error:
        return [Section("Rollout", [f"{str(error).removeprefix(f'{run.path}: ')}."])]
    film: Film | None = Film()
    environment, problem = make_environment(run, request.seed, for_film=True)
    if environment is None:
        film, (environment, problem) = None, make_environment(run, request.seed)
    played = Played()
    try:
        kind, path, model = load_first_whole(run, candidates, environment, "cpu")
        if environment is not None:
            problem = play(model, environment, 1, played, film, MOST_STEPS)
    except SetupError as error:
        return [Section("Rollout", [f"{error}.", *run.problems_with(".zip")])]
    finally:
        if environment is not None:
            environment.close()
    transitions = transitions_played(played)
    return [
        guarded(
            "Rollout", _rollout_section, f"{path.name} ({kind}), after {model.num_timesteps:,} steps", played, film, problem
        ),
        guarded("Effects of the actions", effects_section, run, model, transitions),
        guarded("Guidance along the denoising chain", guidance_section, run, model, transitions),
    ]


def _rollout_section(name: str, played: Played, film: Film | None, problem: str | None) -> Section:
    remarks = []
    if played.returns:
        remarks.append(f"{name}: return {played.returns[0]:.1f} in {played.lengths[0]:,} steps, without exploration noise.")
    else:
        remarks.append(f"{name}: {(problem or 'nothing was played').rstrip('.')}.")
    if film is not None and film.frames:
        return Section("Rollout", remarks, [film.picture("What the policy does in one episode.")])
    why = "the environment has no renderer here" if film is None or film.problem is None else film.problem
    return Section("Rollout", [*remarks, f"No film: {why.rstrip('.')}."])


def serve(connection: Connection, work: Callable[[Request], list[Section]], niceness: int) -> None:
    """
    Answer requests until the other end is closed.

    :param connection: Requests come in, lists of title and HTML go out
    :param work: What makes the answer
    :param niceness: How far others on the machine go first
    """
    th.set_num_threads(1)
    if hasattr(os, "nice"):
        os.nice(niceness)
    with suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            sections = _answer(work, connection.recv())
            connection.send([(section.id, section_html(section)) for section in sections])


def _answer(work: Callable[[Request], list[Section]], request: Request) -> list[Section]:
    try:
        return work(request)
    except Exception as error:  # files that are replaced meanwhile, or are damaged, can raise anything
        return [Section("Rollout", [f"Cannot be played: {type(error).__name__}: {error}."])]


# In this process --------------------------------------------------------------------------------------------------------


class Player:
    """
    The other process, which is started when it is needed.

    :param work: What it does with a request
    :param niceness: How far others on the machine, such as the training, go first
    """

    def __init__(self, work: Callable[[Request], list[Section]] = sections_of_play, niceness: int = NICENESS) -> None:
        self._work = work
        self._niceness = niceness
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: Connection | None = None

    def play(self, request: Request) -> dict[str, str]:
        """
        :param request: A run whose newest model is to play
        :return: HTML of sections by their ids
        """
        try:
            connection = self._connected()
            connection.send(request)
            return dict(connection.recv())
        except (EOFError, OSError):
            self.close()
            return dict([_of_crash()])

    def _connected(self) -> Connection:
        if self._connection is None:
            context = multiprocessing.get_context("spawn")
            self._connection, theirs = context.Pipe()
            self._process = context.Process(target=serve, args=(theirs, self._work, self._niceness), daemon=True)
            self._process.start()
            # Once both ends are closed here, the process sees when this one ends, however it ends
            theirs.close()
        return self._connection

    def close(self) -> None:
        """
        End the process.
        """
        if self._connection is not None and self._process is not None:
            self._connection.close()
            self._process.terminate()
            self._process.join()
        self._connection = self._process = None


def _of_crash() -> tuple[str, str]:
    section = Section("Rollout", ["No film: the process that plays ended, as a renderer without a screen may make it."])
    return section.id, section_html(section)
