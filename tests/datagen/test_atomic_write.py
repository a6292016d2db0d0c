"""Files that are replaced while somebody reads them."""

import os
from pathlib import Path

import pytest

from datagen.atomic_write import write_bytes
from datagen.errors import InputError


class _Reader:
    """A reader that has a file open while it is replaced, as Windows sees it: so many times it refuses."""

    def __init__(self, times: int) -> None:
        self.times, self.tried = times, 0

    def replace(self, source: os.PathLike[str], target: os.PathLike[str]) -> None:
        self.tried += 1
        if self.tried <= self.times:
            raise PermissionError(13, "Access is denied", str(target))
        os.rename(source, target)


@pytest.mark.parametrize("times", [0, 3])
def test_a_file_is_replaced_once_its_reader_lets_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, times: int
) -> None:
    (tmp_path / "there").write_bytes(b"old")
    reader = _Reader(times)
    monkeypatch.setattr("pathlib.Path.replace", lambda source, target: reader.replace(source, target))
    write_bytes(tmp_path / "there", b"new")
    assert reader.tried == times + 1
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
    assert (tmp_path / "there").read_bytes() == b"new"


def test_a_reader_that_never_lets_go_is_told_and_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "there").write_bytes(b"old")
    reader = _Reader(10**9)
    monkeypatch.setattr("datagen.atomic_write.READER_SECONDS", 0.1)
    monkeypatch.setattr("pathlib.Path.replace", lambda source, target: reader.replace(source, target))
    with pytest.raises(InputError, match="there: cannot be written"):
        write_bytes(tmp_path / "there", b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
    assert (tmp_path / "there").read_bytes() == b"old"
