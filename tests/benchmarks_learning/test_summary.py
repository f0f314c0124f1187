import numpy as np
import pytest
import summary


def write(folder, name, seed, returns, every=10):
    rows = [f"{every * (i + 1)},{value},0,{i + 1},{2 * i + 1}" for i, value in enumerate(returns)]
    header = "timesteps,mean_return,std_return,wall_seconds,cpu_seconds"
    (folder / f"Env-v5_{name}_{seed}.csv").write_text("\n".join([header, *rows]) + "\n")


def test_runs_are_compared_at_the_steps_that_all_have(tmp_path):
    write(tmp_path, "own_name", 0, [1.0, 2.0, 3.0])
    write(tmp_path, "own_name", 10, [5.0, 6.0])
    write(tmp_path, "peer", 0, [7.0])
    results = summary.read(tmp_path, "Env-v5")
    assert list(results) == ["own_name", "peer"] and results["own_name"].seeds == [0, 10]
    assert results["own_name"].steps.tolist() == [10, 20]
    assert results["own_name"].returns.tolist() == [[1, 2], [5, 6]]
    # A run that did not come so far does not shorten the others
    assert list(summary.read(tmp_path, "Env-v5", steps=20)) == ["own_name"]
    assert summary.read(tmp_path, "Env-v5", steps=30)["own_name"].seeds == [0]


def test_the_interquartile_mean_is_that_of_the_middle_half():
    assert summary.interquartile_mean(np.array([-100.0, 1.0, 3.0, 900.0])) == 2.0


def test_intervals_cover_as_often_as_they_say():
    generator = np.random.default_rng(0)
    intervals = [summary.with_interval([generator.normal(size=20)], np.mean) for _ in range(100)]
    covered = sum(low <= 0.0 <= high for _, low, high in intervals)
    assert 85 <= covered <= 99
    assert summary.with_interval([np.ones(3)], np.mean) == (1.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("values", "others", "expected"),
    [([2.0, 3.0], [0.0, 1.0], 1.0), ([0.0, 3.0], [1.0, 2.0], 0.5), ([1.0], [1.0], 0.5), ([0.0, 2.0, 4.0], [3.0], 1 / 3)],
)
def test_the_probability_of_improvement_counts_pairs(values, others, expected):
    assert summary.probability_of_improvement(np.array(values), np.array(others)) == pytest.approx(expected)


def test_seconds_to_a_return_are_those_of_the_first_evaluation_that_has_it(tmp_path):
    write(tmp_path, "own", 0, [1.0, 5.0, 4.0])
    write(tmp_path, "own", 1, [1.0, 2.0, 3.0])
    assert summary.seconds_to(summary.read(tmp_path, "Env-v5")["own"], 4.5) == [3.0, np.inf]


def test_the_table_and_the_figure_show_every_algorithm(tmp_path):
    for seed in range(3):
        write(tmp_path, "own", seed, [1.0 + seed, 12.0 + seed])
        write(tmp_path, "peer", seed, [1.0, 2.0])
    results = summary.read(tmp_path, "Env-v5")
    text = summary.table(results, against="peer", level=10.0)
    assert "| own | 3 | 13 +- 1 |" in text and "1 [1, 1]" in text
    assert "CPU seconds to" not in summary.table(results) and "better" not in summary.table(results)
    summary.draw("Env-v5", results, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def test_what_each_seed_reached_is_blank_where_it_was_not_evaluated(tmp_path):
    write(tmp_path, "own", 0, [1.0, 5.4, 4.0])
    write(tmp_path, "own", 1, [1.0])
    rows = summary.table_of_seeds(summary.tables_of(tmp_path, "Env-v5"), [20, 30]).splitlines()
    assert rows[2:] == ["| own | 0 | 5 | 4 | 5 |", "| own | 1 |  |  | 1 |"]
