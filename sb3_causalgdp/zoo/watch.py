"""``causalgdp-zoo watch LOGDIR``: a page in the browser that follows a training while it runs."""

import argparse
import math
import os
import signal
import socket
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from sb3_causalgdp.hints import how_to_install
from sb3_causalgdp.zoo.algorithm import SetupError
from sb3_causalgdp.zoo.watch_folder import WatchedFolder

PROGRAM = "causalgdp-zoo watch"
LOOPBACK = ("localhost", "127.0.0.1")
ANY = "0.0.0.0"


def watch(argv: Sequence[str]) -> None:
    """
    Serve the page until Ctrl-C.

    :param argv: Arguments of the command
    :raises SetupError: If an argument is out of range, or the page cannot be served there
    :raises ImportError: Without Bokeh
    """
    arguments = _parser().parse_args(argv)
    _check(arguments)
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        # Films of MuJoCo's and of classic control's environments on a machine without a screen
        os.environ.setdefault("MUJOCO_GL", "egl")
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _end)
    watched = WatchedFolder(arguments.logdir, arguments.trusted, not arguments.no_play, arguments.seed)
    try:
        server = make_server(watched, arguments.host, arguments.port, arguments.refresh)
        print(f"Watch {arguments.logdir} at {url_of(arguments.host, server.port)} (Ctrl-C ends it)", flush=True)
        server.start()
        server.io_loop.start()
    except KeyboardInterrupt:
        pass
    finally:
        watched.close()


def _end(number: int, frame: FrameType | None) -> None:
    # The process that plays has to end, too
    sys.exit(128 + number)


def make_server(watched: WatchedFolder, host: str, port: int, refresh: float) -> Any:
    """
    :param watched: What its page shows
    :param host: Address to listen on
    :param port: 0 for one that is free
    :param refresh: Seconds between looks
    :return: Bokeh's server, which listens and does not answer yet
    :raises SetupError: If it cannot listen there
    :raises ImportError: Without Bokeh
    """
    try:
        from bokeh.server.server import Server

        from sb3_causalgdp.zoo.watch_page import WatchPage
    except ImportError as error:
        raise ImportError(f"the page needs Bokeh ({error}): {how_to_install('watch')}") from error
    os.environ["BOKEH_RESOURCES"] = "server"

    def open_page(document: Any) -> None:
        WatchPage(document, watched, refresh)

    try:
        port = port or _free_port(host)
        origins = [f"{name}:{port}" for name in names_of(host)]
        return Server({"/": open_page}, address=host, port=port, allow_websocket_origin=origins)
    except OSError as error:
        raise SetupError(f"cannot listen on --host {host} --port {port}: {error.strerror or error}") from error


def names_of(host: str) -> list[str]:
    """
    :param host: Address that the server listens on
    :return: By what names a browser may call it: others' pages, which have other names, get no answer
    """
    if host in LOOPBACK:
        return list(LOOPBACK)
    own = [socket.gethostname(), socket.getfqdn()]
    if host == ANY:
        addresses = {str(entry[4][0]) for name in own for entry in _addresses(name)}
        return [*LOOPBACK, *own, *sorted(address for address in addresses if ":" not in address)]
    return [host, *own]


def _addresses(name: str) -> list[Any]:
    try:
        return list(socket.getaddrinfo(name, None))
    except OSError:
        return []


def _free_port(host: str) -> int:
    """The names under which the page may be called contain it, so that it has to be known before the server is there."""
    with socket.create_server((host, 0)) as listening:
        return listening.getsockname()[1]


def url_of(host: str, port: int) -> str:
    """
    :param host: Address that the server listens on
    :param port: Its port
    :return: What to open in a browser
    """
    return f"http://{socket.gethostname() if host == ANY else host}:{port}/"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(PROGRAM, description="Follow trainings of RL Zoo on a page in the browser.")
    parser.add_argument(
        "logdir",
        type=Path,
        metavar="LOGDIR",
        help="folder of a run, of an algorithm, or of all: logs/causalgdp/Pendulum-v1_1, logs/causalgdp, logs; it may be new",
    )
    parser.add_argument("--host", default="localhost", help="address to listen on (default: localhost, this machine alone)")
    parser.add_argument("--port", type=int, default=5007, help="port to listen on, 0 for a free one (default: 5007)")
    parser.add_argument("--refresh", type=float, default=5.0, help="seconds between looks at the files (default: 5)")
    parser.add_argument("--no-play", action="store_true", help="let the newest model play no episode: no film, no effects")
    parser.add_argument("--seed", type=int, default=0, help="seed of the episode (default: 0)")
    parser.add_argument("--trusted", action="store_true", help="let the files of runs bring code, as your own may")
    return parser


def _check(arguments: argparse.Namespace) -> None:
    if arguments.logdir.exists() and not arguments.logdir.is_dir():
        raise SetupError(f"{arguments.logdir} is a file: give a folder, like logs/causalgdp")
    if not (math.isfinite(arguments.refresh) and 0.1 <= arguments.refresh <= 3_600):
        raise SetupError(f"--refresh must be from 0.1 to 3600 seconds, got {arguments.refresh:g}")
    if not 0 <= arguments.port <= 65_535:
        raise SetupError(f"--port must be from 0 to 65535, got {arguments.port}")
    if ":" in arguments.host:
        raise SetupError(f"--host must be a name or an IPv4 address, which is all that Bokeh checks, got {arguments.host}")
    if arguments.seed < 0:
        raise SetupError(f"--seed must be at least 0, got {arguments.seed}")
