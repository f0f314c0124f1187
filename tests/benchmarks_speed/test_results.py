import pytest

from benchmarks.speed.client import median_ratio
from benchmarks.speed.results import Results, Verdict, markdown, write_summary


@pytest.mark.parametrize(
    "value, at_least, reached",
    [(4.6, True, "goal"), (3.0, True, "must"), (2.9, True, "no"), (2.9, False, "goal"), (3.2, False, "no")],
)
def test_a_target_is_judged_by_what_it_must_and_should_reach(value, at_least, reached):
    goal = 4.5 if at_least else 2.9
    assert Verdict("ratio", value, 3.0, goal, at_least).reached() == reached


def test_what_was_not_measured_is_said():
    assert Verdict("ratio", None, 3.0).reached() == "not measured"
    assert Verdict("ratio", None, 3.0, note="not available: X").reached() == "not available: X"


def test_a_table_leaves_out_empty_columns():
    assert markdown([{"a": 1, "b": None}, {"a": 2.5}], ("a", "b")) == "| a |\n| --- |\n| 1 |\n| 2.5 |\n"


def test_the_summary_has_the_targets_of_all_sections(tmp_path):
    for section, value in (("update", 3.5), ("predict", 0.9)):
        Results(tmp_path, section, [{"contestant": "X"}], [Verdict(f"{section} ratio", value, 3.0)]).write(["contestant"])
    write_summary(tmp_path)
    lines = (tmp_path / "summary.md").read_text().splitlines()
    assert [line.split(" | ")[-2] for line in lines[2:4]] == ["no", "must"]
    assert "see benchmarks.speed.gpu" in lines[-1]


def test_a_ratio_is_taken_within_a_round():
    # The machine is ten times slower in the second round, for both
    assert median_ratio([1.0, 10.0, 1.0], [0.5, 5.0, 0.5]) == 2.0
