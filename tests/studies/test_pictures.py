"""The study of changed pictures, on next to no frames."""

from pathlib import Path

import pytest

from tests.studies import pictures


def test_each_change_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(pictures, "FRAMES", 2)
    monkeypatch.setattr(pictures, "KINDS", ("plain",))
    monkeypatch.setattr(
        pictures, "in_processes", lambda work, recordings: [work(r) for r in recordings]
    )
    pictures.main(["--seeds", "2500", "--out", str(tmp_path)])
    heading, *rows = (line for line in capsys.readouterr().out.splitlines() if " / " in line)
    assert heading.startswith("TPR / FPR")
    assert len(rows) == len(pictures.CHANGES)
    for row, name in zip(rows, pictures.CHANGES, strict=True):
        assert row.lstrip().startswith(name)
        twice = name in pictures.NOT_FILLED or name in pictures.BY_LUMINANCE
        assert row.count(" / ") == (2 if twice else 1)
