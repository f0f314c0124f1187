"""Find the causal graph of recorded transitions from the command line: ``python -m sb3_causalgdp.causal --help``."""

import argparse
import ast
import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

if TYPE_CHECKING:
    from sb3_causalgdp.causal.graph import CausalGraph
    from sb3_causalgdp.causal.transitions import TransitionSource

# Its help is there at once: what takes time to import (PyTorch, gymnasium) is imported where it is used
METHODS = ("direct_lingam", "fully_connected", "notears", "partial_r2", "perturbed", "world_model")
BATCH_ROWS = 4096
SHOWN_EDGES = 40
SHOWN_VALUES = 8
SHOWN_GROUPS = 20


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """A second name behind an option is taken for an argument too many."""
        if message.startswith("unrecognized arguments:") and not message.split()[2].startswith("-"):
            message += "; several names are separated by commas, like --state level,temperature"
        super().error(message)


def make_parser() -> argparse.ArgumentParser:
    """
    :return: the command line's parser
    """
    parser = _Parser(
        prog="python -m sb3_causalgdp.causal",
        usage="%(prog)s SOURCE [options]",
        description="Find the causal graph of recorded transitions with continuous actions, and print what it says.",
    )
    add = parser.add_argument
    add(
        "source",
        metavar="SOURCE",
        help="a table with --state, --action and --reward (.csv, .tsv, .parquet, .npy, .npz), the id of a Minari dataset, a "
        "replay buffer from model.save_replay_buffer (.npz, .pkl), or an .npz file of the arrays observations, actions, "
        "next_observations and rewards",
    )
    table = parser.add_argument_group("columns of a table").add_argument
    table("--state", "--states", metavar="NAMES", help="columns of the state, such as level,temperature")
    table("--action", "--actions", metavar="NAMES", help="columns of the action")
    table("--reward", metavar="NAME", help="column of the reward")
    table("--episode", metavar="NAME", help="column that tells episodes apart (all rows are one)")
    table("--time", metavar="NAME", help="column that must grow within an episode; no transition over a gap")
    table("--next-state", "--next-states", metavar="NAMES", help="columns of the next state (the state --lag rows later)")
    table("--lag", type=_positive, default=1, metavar="N", help="rows from a state to the next one (%(default)s)")
    table("--drop-missing", action="store_true", help="leave out transitions with a missing value")
    add("--state-names", metavar="NAMES", help="of a source that is no table: what to call its states (obs[0], obs[1], ...)")
    add("--action-names", metavar="NAMES", help="the same for its actions (action[0], ...)")
    add("--method", default="partial_r2", help=f"discovery method, one of {', '.join(METHODS)} (%(default)s)")
    add(
        "--method-kwargs", nargs="+", default=[], metavar="KEY=VALUE", help="arguments of the method, or a JSON object of them"
    )
    add(
        "--relevance", action="store_true", help="how surely each variable can matter for any future reward, and by which path"
    )
    add("--plot", metavar="FILE", help="image to draw, such as graph.png")
    add(
        "--plot-kwargs",
        nargs="+",
        default=[],
        metavar="KEY=VALUE",
        help="what it shows: kind (both, heat_map, graph), values (effects, masks), causes, groups, max_variables, aggregate, "
        "size, as for CausalGraph.plot",
    )
    add("--json", metavar="FILE", help="file for the whole graph, which CausalGraph.load reads")
    add("--window", type=_positive, metavar="N", help="keep the newest N transitions only")
    add("--half-life", type=_positive, metavar="N", help="number of transitions after which an old one weighs half")
    add("--max-rows", type=_positive, metavar="N", help="read at most N transitions, spread evenly over all")
    add("--download", action="store_true", help="download a Minari dataset that is not on this machine")
    add("--trusted", action="store_true", help="read a pickle that holds more than a buffer of SB3, which could run code")
    add("--quiet", action="store_true", help="no progress bar and no summary")
    return parser


def _positive(text: str) -> int:
    try:
        number = int(text.replace("_", ""))
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be an integer of at least 1, got {text!r}")
    return number


def parse_kwargs(items: Sequence[str], option: str = "--method-kwargs") -> dict[str, Any]:
    """
    :param items: Each ``key=value``, or a JSON object
    :param option: What they were given as
    :return: the arguments by name; values are read as JSON, else as Python, else they are strings
    :raises ValueError: on anything else
    """
    kwargs: dict[str, Any] = {}
    for item in items:
        if item.lstrip().startswith("{"):
            try:
                kwargs.update(json.loads(item))
            except (ValueError, RecursionError) as error:
                raise ValueError(f"{option}: {item[:80]!r} is no JSON object: {error}") from error
        else:
            key, equals, value = item.partition("=")
            if not (equals and key.isidentifier()):
                raise ValueError(f"{option} must be key=value or a JSON object, got {item!r}")
            kwargs[key] = _value_of(value)
    return kwargs


def _value_of(text: str) -> Any:
    for parse in (json.loads, ast.literal_eval):
        try:
            return parse(text)
        except (ValueError, SyntaxError, RecursionError, MemoryError):  # what their parsers raise on too many brackets
            continue
    return text


def main(argv: Sequence[str] | None = None) -> None:
    """
    Run the command line.

    :param argv: Its arguments, by default those of the process
    """
    parser = make_parser()
    arguments = parser.parse_args(argv)
    try:
        run(arguments)
    except (ValueError, OSError, ImportError) as error:
        parser.error(" ".join(str(error).split()))


def run(arguments: argparse.Namespace) -> None:
    """
    Read, discover, print and write.

    :param arguments: What the parser made
    :raises ValueError: on what the user got wrong
    """
    from sb3_causalgdp.causal.discovery import make_discovery, make_statistics

    drawn = _checked_plot(arguments)
    kwargs = parse_kwargs(arguments.method_kwargs)
    with _as_value_error("--method-kwargs"):
        method = make_discovery(arguments.method, **kwargs)
    start = time.perf_counter()
    source, remarks = _open(arguments)
    with _as_value_error("--method-kwargs"):
        statistics = make_statistics(method, source.variables, arguments.half_life, arguments.window)
    if source.n_rows == 0:
        raise ValueError(f"{source.name} holds no transitions")
    # Rows of one batch are weighted alike
    batch_rows = BATCH_ROWS if arguments.half_life is None else min(BATCH_ROWS, -(-arguments.half_life // 10))
    feed(statistics, source, batch_rows, arguments.quiet)
    read = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        graph = method(statistics, source.variables)
    graph = replace(graph, remarks=(*graph.remarks, *remarks))
    found = time.perf_counter()
    if arguments.json is not None:
        graph.save(arguments.json)
    if not arguments.quiet:
        print(summary_of(graph, source))
        if arguments.relevance:
            print(relevance_summary(graph))
        print(f"time: {found - start:.1f} s ({read - start:.1f} s reading, {found - read:.1f} s discovery)")
    for warning in caught:
        print(f"warning: {warning.message}", file=sys.stderr)
    if arguments.plot is not None:
        graph.plot(arguments.plot, **drawn)


def _checked_plot(arguments: argparse.Namespace) -> dict[str, Any]:
    """Before anything is read, so that a missing package or a wrong option costs no time."""
    options = parse_kwargs(arguments.plot_kwargs, "--plot-kwargs")
    if arguments.plot is None:
        if options:
            raise ValueError("--plot-kwargs need --plot FILE")
        return {}
    from sb3_causalgdp.causal.plots.figures import check_choice, check_suffix
    from sb3_causalgdp.causal.plots.graphs import KINDS
    from sb3_causalgdp.causal.plots.view import view_of

    check_suffix(arguments.plot)
    kind = options.pop("kind", "both")
    with _as_value_error("--plot-kwargs"):
        check_choice("kind", kind, KINDS)
        return {"kind": kind, "view": view_of(None, options)}


def _open(arguments: argparse.Namespace) -> "tuple[TransitionSource, tuple[str, ...]]":
    """The source, and what is to be said of it."""
    from sb3_causalgdp.sources.columns import SUFFIXES

    roles = {name: getattr(arguments, name) for name in ("state", "action", "reward", "episode", "time", "next_state")}
    path = Path(arguments.source)
    is_table = path.suffix.lower() in SUFFIXES and path.suffix.lower() != ".npz"
    if not is_table and not any(roles.values()):
        from sb3_causalgdp.causal.sources import open_source

        source = open_source(
            arguments.source, download=arguments.download, max_rows=arguments.max_rows, trusted=arguments.trusted
        )
        return _renamed(source, arguments), ()
    if arguments.state_names is not None or arguments.action_names is not None:
        raise ValueError("the names of a table are those of its columns: --state-names and --action-names are for others")
    from sb3_causalgdp.causal.transitions import TableSource
    from sb3_causalgdp.sources.columns import read_columns
    from sb3_causalgdp.sources.tables import Table

    columns = read_columns(path)
    missing = [f"--{name}" for name in ("state", "action", "reward") if roles[name] is None]
    if missing:
        raise ValueError(f"{path} is a table and needs {', '.join(missing)}: its columns are {', '.join(columns)}")
    table = Table(
        columns,
        states=_names(roles["state"]),
        actions=_names(roles["action"]),
        reward=roles["reward"],
        episode=roles["episode"],
        time=roles["time"],
        next_states=None if roles["next_state"] is None else _names(roles["next_state"]),
        lag=arguments.lag,
        missing="drop" if arguments.drop_missing else "raise",
        name=str(path),
    )
    return TableSource(table, arguments.max_rows), table.remarks


def _renamed(source: "TransitionSource", arguments: argparse.Namespace) -> "TransitionSource":
    for option, argument in (("--state-names", "state_names"), ("--action-names", "action_names")):
        given = getattr(arguments, argument)
        if given is not None:
            own = getattr(source.variables, argument)
            if len(_names(given)) != len(own):
                raise ValueError(f"{option} must be {len(own)} names for {', '.join(own)}, got {given!r}")
            source.variables = replace(source.variables, **{argument: tuple(_names(given))})
    return source


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


@contextmanager
def _as_value_error(argument: str) -> Iterator[None]:
    """Arguments of a wrong type are the user's mistake, too."""
    try:
        yield
    except TypeError as error:
        raise ValueError(f"{argument}: {error}") from error


def feed(statistics: Any, source: "TransitionSource", batch_rows: int = BATCH_ROWS, quiet: bool = False) -> None:
    """
    Hand all rows of a source to the statistics of a method.

    :param statistics: What ``make_statistics`` made
    :param source: Where the rows come from; read again if the statistics ask for it
    :param batch_rows: Number of rows at a time
    :param quiet: Whether to show no progress bar
    :raises ValueError: on rows that are not finite; the message says which
    """
    n_read = 0
    with _progress("reading", source.n_rows, quiet) as advance:
        for rows in source.batches(batch_rows):
            _check_finite(rows, n_read, source)
            statistics.update(rows)
            n_read += len(rows)
            advance(len(rows))
    if getattr(statistics, "wants_history", False):
        statistics.restart()
        with _progress("reading again", source.n_rows, quiet) as advance:
            for rows in source.batches(batch_rows):
                statistics.refill(rows)
                advance(len(rows))


def _check_finite(rows: np.ndarray, n_read: int, source: "TransitionSource") -> None:
    bad = ~np.isfinite(rows)
    if bad.any():
        row = int(bad.any(axis=1).argmax())
        names = ", ".join(np.array(source.variables.names)[bad[row]])
        raise ValueError(f"{source.name}: transition {n_read + row} is NaN or infinite in {names}")


@contextmanager
def _progress(label: str, n_rows: int, quiet: bool) -> Iterator[Callable[[int], object]]:
    """Gives what to call with each batch's number of rows."""
    try:
        from tqdm import tqdm
    except ImportError:
        yield lambda n_rows: None
        return
    # None: no bar where there is no terminal
    disable = True if quiet else None
    with tqdm(total=n_rows, desc=label, unit=" rows", unit_scale=True, leave=False, disable=disable) as bar:
        yield bar.update


# Summary ----------------------------------------------------------------------------------------------------------------


def summary_of(graph: "CausalGraph", source: "TransitionSource") -> str:
    """
    :param graph: The graph
    :param source: What it was found from
    :return: the edges and what limits them, in lines for a terminal
    """
    from sb3_causalgdp.causal.statistics.degenerate import CONFOUNDED_VIF

    variables = source.variables
    part = "" if source.n_rows == source.n_stored else f" of {source.n_stored:,}"
    lines = [
        f"{source.name}: {source.n_rows:,}{part} transitions",
        f"state variables: {variables.n_states}, action variables: {variables.n_actions}",
        *_edge_lines(graph),
    ]
    if graph.r_squared is not None:
        effects = (*variables.next_state_names, "reward")
        lines.append(f"R^2: {_extreme_values(effects, graph.r_squared, 'lowest', '.3f')}")
    if graph.action_vif is not None:
        shown = _extreme_values(variables.action_names, graph.action_vif, "highest", ".3g")
        lines.append(f"variance inflation (over {CONFOUNDED_VIF:g}: the states almost determine the action): {shown}")
    if graph.constant_variables:
        lines.append(f"constant, without edges: {_shortened(graph.constant_variables)}")
    if graph.duplicated_variables:
        groups = [" = ".join(group) for group in graph.duplicated_variables]
        lines.append(f"linearly dependent, share their masks: {_shortened(groups)}")
    lines += [f"remark: {remark}" for remark in graph.remarks]
    return "\n".join(lines)


def relevance_summary(graph: "CausalGraph") -> str:
    """
    :param graph: The graph
    :return: relevance and surest path of each state and action, in lines for a terminal
    """
    from sb3_causalgdp.causal.relevance import ASSUMPTION

    relevance = graph.relevance()
    rows = relevance.rows()
    shown, rest = rows[:SHOWN_EDGES], rows[SHOWN_EDGES:]
    width = max(len(name) for name, *_ in shown)
    lines = ["relevance for any future reward, and the surest path:"]
    lines += [f"  {value:.2f}  {name:>{width}}  {path or '-'}" for name, value, _, path in shown]
    if rest:
        lines.append(f"  and {len(rest)} more, of at most {rest[0][1]:.2f}")
    return "\n".join([*lines, ASSUMPTION])


def _edge_lines(graph: "CausalGraph") -> list[str]:
    from sb3_causalgdp.causal.description import count_of_edges

    edges = graph.edges()
    edges.sort(key=lambda edge: (-round(edge.mask, 2), -abs(edge.strength)))
    shown = edges[:SHOWN_EDGES]
    lines = [f"{graph.method}: {count_of_edges(graph)}"]
    width = max((len(edge.cause) for edge in shown), default=0)
    for edge in shown:
        error = "" if np.isnan(edge.standard_error) else f" +- {edge.standard_error:<7.2g}"
        lines.append(f"  {edge.mask:.2f}  {edge.strength:+.2f}{error}  {edge.cause:>{width}} -> {edge.effect}")
    if shown:
        lines.insert(1, "  mask, effect in standard deviations, edge")
    if len(edges) > len(shown):
        lines.append(f"  and {len(edges) - len(shown)} more (--json FILE has them all)")
    return lines


def _extreme_values(names: Sequence[str], values: np.ndarray, which: str, digits: str) -> str:
    """All values, or the few that say most."""
    order = np.argsort(values if which == "lowest" else -values, kind="stable")[:SHOWN_VALUES]
    if len(values) <= SHOWN_VALUES:
        order, remark = np.arange(len(values)), ""
    else:
        remark = f" (the {which} {SHOWN_VALUES} of {len(values)})"
    return ", ".join(f"{names[i]} {values[i]:{digits}}" for i in order) + remark


def _shortened(names: Sequence[str]) -> str:
    more = f" and {len(names) - SHOWN_GROUPS} more" if len(names) > SHOWN_GROUPS else ""
    return ", ".join(names[:SHOWN_GROUPS]) + more


if __name__ == "__main__":
    main()
