import json

import pytest
import torch as th

from benchmarks.speed import gpu


def test_every_setting_is_measured_in_every_mode(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(gpu, "STARTS", 100)
    arguments = ["--device", "cpu", "--modes", "plain", "--updates", "1", "--rounds", "1", "--rows", "600", "--steps", "32"]
    gpu.main([*arguments, "--output", str(tmp_path / "rows.json")])
    printed = capsys.readouterr().out
    found = json.loads((tmp_path / "rows.json").read_text())
    rows, learn = found["updates"], found["learn"]
    assert len({row["contestant"] for row in rows}) == len(rows) == 3
    for row in rows:
        assert row["contestant"] in printed and row["mode"] == "plain" and row["deviation"] == 0.0
        assert row["updates/s"] > 0.0 and row["one at a time"] > 0.0 and row["ms of products"] > 0.0
    assert [row["contestant"].rsplit(", ")[-1] for row in learn] == ["1 environments", "16 environments"]
    assert all(row["steps/s"] > 0.0 and row["contestant"] in printed for row in learn)


def test_without_a_gpu_it_says_so(monkeypatch, capsys):
    monkeypatch.setattr(th.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit):
        gpu.main([])
    assert "PyTorch finds no GPU here" in capsys.readouterr().err
