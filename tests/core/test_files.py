"""Files are written whole or not at all, and what cannot be read is named."""

import os
from pathlib import Path

import pytest
from support.refusals import raised

from visioncal.core.errors import DataError
from visioncal.core.files import (
    check_free,
    decode_text,
    parse_toml,
    read_bytes,
    read_text_inside,
    write_atomically,
)


def test_failed_write_leaves_the_old_content_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    write_atomically(path, "old")

    def full_disk(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    raised(DataError, r"a\.txt cannot be written: No space left", write_atomically, path, "new")
    assert [(entry.name, entry.read_text()) for entry in tmp_path.iterdir()] == [("a.txt", "old")]


def test_missing_file_and_folder_are_named(tmp_path):
    raised(DataError, r"nowhere\.txt does not exist", read_bytes, tmp_path / "nowhere.txt")
    (tmp_path / "images" / "view10").mkdir(parents=True)
    raised(DataError, r"is a folder, and no file. Check the path", read_bytes, tmp_path / "images")
    raised(DataError, "cannot be written", write_atomically, tmp_path / "missing" / "a.txt", "")


def test_what_might_never_end_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    for path in (tmp_path / "pipe.csv", Path("/dev/zero")):
        raised(DataError, "is no regular file", read_bytes, path)
    (tmp_path / "large.csv").write_bytes(bytes(11))
    assert len(read_bytes(tmp_path / "large.csv", 11)) == 11
    raised(DataError, "has more than", read_bytes, tmp_path / "large.csv", 10)


@pytest.mark.parametrize(
    ("name", "words"),
    [("ä" * 128, "too long"), ("a\0b", "does not exist"), ("a/" * 3000, "too long")],
)
def test_names_that_no_file_has_are_refused(name, words, tmp_path):
    raised(DataError, words, read_bytes, tmp_path / name)


def test_a_link_out_of_a_folder_is_not_followed(tmp_path):
    (tmp_path / "secret.csv").write_text("secret")
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "inner.csv").write_text("inner")
    (folder / "alias.csv").symlink_to("inner.csv")
    (folder / "out.csv").symlink_to(tmp_path / "secret.csv")
    (folder / "loop.csv").symlink_to("loop.csv")
    (tmp_path / "link").symlink_to(folder)
    assert read_text_inside(tmp_path / "link", "alias.csv") == "inner"
    raised(DataError, "leads out of its folder", read_text_inside, folder, "out.csv")
    with pytest.raises(DataError):
        read_text_inside(folder, "loop.csv")


def test_text_may_have_a_byte_order_mark_but_must_be_utf8():
    assert decode_text(b"\xef\xbb\xbfview", "x.csv") == "view"
    with pytest.raises(DataError, match=r"x\.csv, line 2: byte 0xe4 is not UTF-8"):
        decode_text(b"view\ngr\xe4n", "x.csv")


def test_toml_errors_give_the_line():
    with pytest.raises(DataError, match=r"x\.toml is not valid TOML: .*line 2"):
        parse_toml("a = 1\nb = [1,, 2]", "x.toml")


def test_a_link_that_leads_nowhere_is_not_replaced_unasked(tmp_path):
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "nowhere")
    raised(DataError, "nothing is overwritten", check_free, link, force=False)
    check_free(link, force=True)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[" * 3000 + "]" * 3000, "nested deeper"),
        (".".join("a" * 100) + " = 1", "nested deeper"),
        (f"a.b = {2**63}", r"a\.b has more than the 64 bits"),
        ("a = " + "9" * 5000, "is not valid TOML"),
    ],
)
def test_toml_that_no_one_writes_is_refused(text, words):
    raised(DataError, words, parse_toml, text, "x.toml")
