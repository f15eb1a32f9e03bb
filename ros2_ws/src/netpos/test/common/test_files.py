"""Files are whole or not there; errors name the file."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest
from netpos.common.files import naming, whole_file, write_text


def test_a_whole_file_takes_the_place_of_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.json"
    write_text(path, "one")
    write_text(path, "two")
    assert path.read_text() == "two"
    assert [file.name for file in path.parent.iterdir()] == ["a.json"]


def fail_half_way(path: Path, error: BaseException) -> None:
    with whole_file(path) as draft:
        assert draft.suffix == path.suffix
        draft.write_text("half")
        raise error


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "x"), KeyboardInterrupt(), ValueError()])
def test_work_that_fails_leaves_what_was_there(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "a.html"
    for before in (None, "old"):
        if before is not None:
            path.write_text(before)
        with pytest.raises(type(error)) as raised:
            fail_half_way(path, error)
        assert [f.read_text() for f in tmp_path.iterdir()] == ([] if before is None else [before])
        if isinstance(error, OSError):
            assert raised.value.filename == str(path)
            assert raised.value.strerror == "No space left on device"


def test_a_full_device_is_named(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space left on device: '/dev/full'"):
        write_text(Path("/dev/full"), "x" * 100_000)
    assert Path("/dev/full").is_char_device()
    with pytest.raises(OSError, match="'there'"), naming(Path("there")):
        raise OSError(errno.EIO, "x")


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    real, link = tmp_path / "real" / "a.csv", tmp_path / "link.csv"
    real.write_text("old")
    link.symlink_to(real)
    write_text(link, "new")
    assert link.is_symlink()
    assert real.read_text() == "new"


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(OSError, match="file"):
        write_text(tmp_path / "file" / "a.json", "x")
