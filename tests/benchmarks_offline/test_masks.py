import pytest

from benchmarks.offline import masks


def test_a_mask_of_zero_closes_and_a_small_one_is_made_up_for(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    masks.main(["--masks", "1", "0.1", "0", "--updates", "600", "--dataset-steps", "3000"])
    rows = [line.split("|")[1:3] for line in capsys.readouterr().out.splitlines()[2:]]
    by_mask = {float(mask): float(value) for mask, value in rows}
    assert by_mask[0.0] == 0.0
    assert by_mask[0.1] == pytest.approx(by_mask[1.0], rel=0.2) and by_mask[1.0] > 0.1
