"""The study of changed pictures, on next to no frames."""

from pathlib import Path

import pytest

from tests.studies import pictures

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "FRAMES", 2)
    monkeypatch.setattr(pictures, "KINDS", ("plain",))
    monkeypatch.setattr(
        pictures, "in_processes", lambda work, recordings: [work(r) for r in recordings]
    )


def test_each_change_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pictures.main(["--seeds", "2500", "--out", str(tmp_path)])
    heading, *rows = (line for line in capsys.readouterr().out.splitlines() if " / " in line)
    assert heading.startswith("TPR / FPR")
    assert len(rows) == len(pictures.CHANGES)
    for row, name in zip(rows, pictures.CHANGES, strict=True):
        assert row.lstrip().startswith(name)
        twice = name in pictures.NOT_RESTORED or name in pictures.BY_LUMINANCE
        assert row.count(" / ") == (2 if twice else 1)
