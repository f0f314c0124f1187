import json

import pytest
import torch as th

from benchmarks.speed import gpu


def test_every_setting_is_measured_in_every_mode(tmp_path, capsys):
    arguments = ["--device", "cpu", "--modes", "plain", "--updates", "1", "--rounds", "1", "--rows", "600"]
    gpu.main([*arguments, "--output", str(tmp_path / "rows.json")])
    printed = capsys.readouterr().out
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert len({row["contestant"] for row in rows}) == len(rows) == 3
    for row in rows:
        assert row["contestant"] in printed and row["mode"] == "plain" and row["deviation"] == 0.0
        assert row["updates/s"] > 0.0 and row["one at a time"] > 0.0 and row["ms of products"] > 0.0


def test_without_a_gpu_it_says_so(monkeypatch, capsys):
    monkeypatch.setattr(th.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit):
        gpu.main([])
    assert "PyTorch finds no GPU here" in capsys.readouterr().err
