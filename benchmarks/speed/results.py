"""What a section leaves behind: every number as JSON, a table, and how its targets came out."""

import json
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

Row = dict[str, Any]
NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class Verdict:
    """
    A target and what was measured.

    :param what: Ratio or share
    :param value: Measured, None if it could not be
    :param must: What it has to reach
    :param goal: What it should reach, None if there is no more than ``must``
    :param at_least: Whether larger is better
    :param note: Why there is no value
    """

    what: str
    value: float | None
    must: float | None
    goal: float | None = None
    at_least: bool = True
    note: str = ""

    def reached(self) -> str:
        """``goal``, ``must``, ``no`` or why nothing can be said."""
        if self.value is None:
            return self.note or NOT_MEASURED
        for name, wanted in (("goal", self.goal), ("must", self.must)):
            if wanted is not None and (self.value >= wanted if self.at_least else self.value <= wanted):
                return name
        return "no target" if self.must is None else "no"

    def row(self) -> Row:
        """A line of the table."""
        sign = ">=" if self.at_least else "<="
        wanted = [f"{sign} {one:g}" if one is not None else "" for one in (self.must, self.goal)]
        return {"what": self.what, "measured": self.value, "must": wanted[0], "goal": wanted[1], "reached": self.reached()}


@dataclass
class Results:
    """
    :param folder: Where the files go
    :param section: Their name
    """

    folder: Path
    section: str
    rows: list[Row] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    about: Row = field(default_factory=dict)

    def write(self, columns: Sequence[str]) -> None:
        """
        Write ``<section>.json`` and ``<section>.md`` and print the table.

        :param columns: Of the table, keys of the rows
        """
        table = markdown(self.rows, columns)
        content = {
            "date": date.today().isoformat(),
            "command": " ".join(["python -m benchmarks.speed.compare", *sys.argv[1:]]),
            "machine": machine(),
            "about": self.about,
            "rows": self.rows,
            "verdicts": [asdict(verdict) for verdict in self.verdicts],
        }
        replace_text(self.folder / f"{self.section}.json", json.dumps(content, indent=1) + "\n")
        judged = markdown([verdict.row() for verdict in self.verdicts], VERDICT_COLUMNS)
        replace_text(self.folder / f"{self.section}.md", f"{table}\n{judged}")
        print(f"\n{self.section}\n{table}\n{judged}", flush=True)


VERDICT_COLUMNS = ("what", "measured", "must", "goal", "reached")


def write_summary(folder: Path) -> None:
    """
    Write ``summary.md``: the targets of all sections whose results are in the folder.

    :param folder: Where the sections' files are
    """
    rows: list[Row] = []
    for path in sorted(folder.glob("*.json")):
        content = json.loads(path.read_text(encoding="utf-8"))
        for verdict in content["verdicts"]:
            rows.append({"section": path.stem, "date": content["date"], **Verdict(**verdict).row()})
    rows.append({"section": "all", "date": "", "what": "on a GPU", "measured": None, "reached": "see benchmarks.speed.gpu"})
    text = markdown(rows, ("section", *VERDICT_COLUMNS, "date"))
    replace_text(folder / "summary.md", text)
    print(f"\nsummary\n{text}", flush=True)


def markdown(rows: Sequence[Row], columns: Sequence[str]) -> str:
    """
    :param rows: Lines of the table
    :param columns: Their keys, in order; an empty column is left out
    :return: The table, empty if there are no rows
    """
    columns = [name for name in columns if any(row.get(name) not in (None, "") for row in rows)]
    if not columns:
        return ""
    lines = [columns, ["---"] * len(columns), *([_cell(row.get(name)) for name in columns] for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1_000 else f"{value:,.0f}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def machine() -> Row:
    """Processor, number of processors, interpreter and the version of the code."""
    cpu_info = Path("/proc/cpuinfo")
    models = [line for line in cpu_info.read_text().splitlines() if "model name" in line] if cpu_info.exists() else []
    processor = models[0].partition(":")[2].strip() if models else platform.processor()
    return {
        "processor": processor,
        "processors": os.cpu_count(),
        "load": [round(value, 2) for value in os.getloadavg()],
        "python": platform.python_version(),
        "commit": _commit(),
    }


def _commit() -> str:
    def git(*arguments: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()

    changed = git("status", "--porcelain", "--", ":/sb3_causalgdp")
    return git("rev-parse", "--short", "HEAD") + (" with changes" if changed else "")


def replace_text(path: Path, text: str) -> None:
    """
    :param path: File that is replaced only once the new one is complete
    :param text: Its contents
    """
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)
