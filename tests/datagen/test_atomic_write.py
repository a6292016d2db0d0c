"""Files that are replaced while somebody reads them."""

import os
from pathlib import Path

import pytest

from datagen.atomic_write import write_bytes
from datagen.errors import InputError


def _refuse(monkeypatch: pytest.MonkeyPatch, times: int) -> list[Path]:
    """Let files be replaced only after so many refusals, as Windows does while a reader has them open."""
    tried: list[Path] = []

    def replace(source: Path, target: Path) -> None:
        tried.append(target)
        if len(tried) <= times:
            raise PermissionError(13, "Access is denied", str(target))
        os.rename(source, target)

    monkeypatch.setattr("pathlib.Path.replace", replace)
    return tried


@pytest.mark.parametrize("times", [0, 3])
def test_a_file_is_replaced_once_its_reader_lets_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, times: int
) -> None:
    (tmp_path / "there").write_bytes(b"old")
    tried = _refuse(monkeypatch, times)
    write_bytes(tmp_path / "there", b"new")
    assert len(tried) == times + 1
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
    assert (tmp_path / "there").read_bytes() == b"new"


def test_a_reader_that_never_lets_go_is_told_and_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "there").write_bytes(b"old")
    monkeypatch.setattr("datagen.atomic_write.READER_SECONDS", 0.1)
    assert not _refuse(monkeypatch, 10**9)
    with pytest.raises(InputError, match="there: cannot be written"):
        write_bytes(tmp_path / "there", b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
    assert (tmp_path / "there").read_bytes() == b"old"
