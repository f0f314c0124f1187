import pytest

pytest.importorskip("pandas")
pytest.importorskip("matplotlib")

from benchmarks.offline.plot import draw_curves, draw_scores, markdown, read

HEADER = "task,method,seed,checkpoint,updates,score,mean_return,std_return,episodes,train_cpu_seconds"


@pytest.fixture
def table(tmp_path):
    lines = [HEADER]
    for task in ("maze2d-umaze-dense", "maze2d-umaze"):
        for method, score in (("iql", 20), ("causalgdp", 50)):
            for seed in (0, 1):
                lines += [f"{task},{method},{seed},training,{n},{score + seed + n},0,0,20,1.0" for n in (5, 10)]
                lines += [f"{task},{method},{seed},{name},10,{score + 2 * seed},0,0,100,30.0" for name in ("last", "best")]
    lines.append("maze2d-umaze,planner,0,last,10,150.4,0,0,100,0.0")
    (tmp_path / "results.csv").write_text("\n".join(lines) + "\n")
    return read(tmp_path / "results.csv")


def test_the_table_has_means_and_deviations_over_seeds_in_the_order_of_the_study(table):
    lines = markdown(table).splitlines()
    columns = "maze2d-umaze: last | best | maze2d-umaze-dense: last | best | seeds | updates | CPU min"
    assert lines[0] == f"| method | {columns} |"
    assert lines[2] == "| CausalGDP | 51 +- 1 | 51 +- 1 | 51 +- 1 | 51 +- 1 | 2 | 10 | 0.5 |"
    assert lines[3].startswith("| IQL | 21 +- 1 |")
    assert lines[4] == "| planner, knows the maze | 150 | not run | not run | not run | 1 |  |  |"


def test_the_pictures_are_drawn(table, tmp_path):
    draw_curves(table, tmp_path / "curves.png")
    draw_scores(table, tmp_path / "scores.png")
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for name in ("curves.png", "scores.png"))
