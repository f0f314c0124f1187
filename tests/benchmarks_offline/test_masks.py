import pytest

from benchmarks.offline import masks


def test_a_mask_of_zero_closes_and_a_small_one_is_made_up_for_unless_it_is_drawn(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    masks.main(["--masks", "1", "0.1", "0", "--updates", "600", "--counts", "--dataset-steps", "3000"])
    rows = [line.split("|")[1:4] for line in capsys.readouterr().out.split("\n\n")[0].splitlines()[2:]]
    scaled, drawn = (
        {float(mask): float(value) for mask, kind, value in rows if kind.strip() == one} for one in ("scaled", "drawn")
    )
    assert scaled[0.0] == drawn[0.0] == 0.0
    assert scaled[0.1] == pytest.approx(scaled[1.0], rel=0.2) and scaled[1.0] > 0.1
    assert drawn[0.1] < 0.4 * drawn[1.0] and drawn[1.0] > 0.1


def test_the_error_after_learning_from_few_transitions_is_that_on_others(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    arguments = ["--masks", "--updates", "300", "--counts", "300", "--seeds", "1", "--dataset-steps", "6000"]
    masks.main(arguments)
    rows = [line.split("|")[1:5] for line in capsys.readouterr().out.split("\n\n")[1].splitlines()[2:]]
    found = {kind.strip(): float(error.split("+-")[0]) for _, kind, error, _ in rows}
    # Some of what changes is explained, and not all of it
    assert set(found) == {"open", "scaled", "drawn"} and all(0.001 < error < 0.5 for error in found.values())
