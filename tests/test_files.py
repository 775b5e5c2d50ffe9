"""Files are written whole or not at all, and what cannot be read is named."""

from pathlib import Path

import pytest

from visioncal.errors import DataError
from visioncal.files import (
    Table,
    check_free,
    decode_text,
    did_you_mean,
    parse_toml,
    read_bytes,
    read_text,
    write_atomically,
)


def test_text_survives_odd_paths(tmp_path: Path) -> None:
    path = tmp_path / "Zelle 3, größe.txt"
    write_atomically(path, "µm\r\n")
    assert read_bytes(path) == "µm\r\n".encode()
    write_atomically(path, b"second")
    assert read_text(path) == "second"
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_failed_write_leaves_the_old_content_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.txt"
    write_atomically(path, "old")

    def full_disk(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(DataError, match=r"a\.txt cannot be written: No space left"):
        write_atomically(path, "new")
    assert [(entry.name, entry.read_text()) for entry in tmp_path.iterdir()] == [("a.txt", "old")]


def test_missing_file_and_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere\.txt does not exist"):
        read_bytes(tmp_path / "nowhere.txt")
    with pytest.raises(DataError, match="cannot be read"):
        read_bytes(tmp_path)
    with pytest.raises(DataError, match="cannot be written"):
        write_atomically(tmp_path / "missing" / "a.txt", "")


def test_text_may_have_a_byte_order_mark_but_must_be_utf8() -> None:
    assert decode_text(b"\xef\xbb\xbfview", "x.csv") == "view"
    with pytest.raises(DataError, match=r"x\.csv, line 2: byte 0xe4 is not UTF-8"):
        decode_text(b"view\ngr\xe4n", "x.csv")


def test_toml_errors_give_the_line() -> None:
    with pytest.raises(DataError, match=r"x\.toml is not valid TOML: .*line 2"):
        parse_toml("a = 1\nb = [1,, 2]", "x.toml")


def test_near_names_are_suggested() -> None:
    assert "resolution" in did_you_mean("resolutoin", ["resolution", "model"])
    assert did_you_mean("zzz", ["resolution", "model"]) == ""


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({}, "a is missing"),
        ({"a": "3"}, "a is '3'; a number above 0"),
        ({"a": True}, "a is True"),
        ({"a": float("nan")}, "a is nan"),
        ({"a": -1}, "a is -1"),
    ],
)
def test_a_number_that_does_not_serve_is_refused_by_name(
    content: dict[str, object], words: str
) -> None:
    with pytest.raises(DataError, match=words) as caught:
        Table(content, "robot x").number("a", positive=True)
    assert caught.value.culprits == ("robot x: a",)


def test_a_link_that_leads_nowhere_is_not_replaced_unasked(tmp_path):
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "nowhere")
    with pytest.raises(DataError, match="nothing is overwritten"):
        check_free(link, force=False)
    check_free(link, force=True)


def test_a_name_that_no_disk_takes_is_named(tmp_path):
    with pytest.raises(DataError, match="cannot be written"):
        check_free(tmp_path / ("x" * 300), force=False)
