"""Files are written whole or not at all, and what cannot be read is named."""

import os
from pathlib import Path

import pytest

from visioncal.core.errors import DataError
from visioncal.core.files import (
    DocumentTable,
    check_free,
    decode_text,
    parse_toml,
    read_bytes,
    read_text,
    read_text_inside,
    write_atomically,
)
from visioncal.core.number_format import did_you_mean


def test_text_survives_odd_paths(tmp_path):
    path = tmp_path / "Zelle 3, größe.txt"
    write_atomically(path, "µm\r\n")
    assert read_bytes(path) == "µm\r\n".encode()
    write_atomically(path, b"second")
    assert read_text(path) == "second"
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_failed_write_leaves_the_old_content_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    write_atomically(path, "old")

    def full_disk(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(DataError, match=r"a\.txt cannot be written: No space left"):
        write_atomically(path, "new")
    assert [(entry.name, entry.read_text()) for entry in tmp_path.iterdir()] == [("a.txt", "old")]


def test_missing_file_and_folder_are_named(tmp_path):
    with pytest.raises(DataError, match=r"nowhere\.txt does not exist"):
        read_bytes(tmp_path / "nowhere.txt")
    (tmp_path / "images" / "view10").mkdir(parents=True)
    with pytest.raises(DataError, match=r"is a folder, and no file. Check the path"):
        read_bytes(tmp_path / "images")
    for name in ("view10.png", "view2.png"):
        (tmp_path / "images" / name).touch()
    with pytest.raises(DataError, match=r"Name a file in it, such as .*view2\.png\.$"):
        read_bytes(tmp_path / "images")
    with pytest.raises(DataError, match="cannot be written"):
        write_atomically(tmp_path / "missing" / "a.txt", "")


def test_what_might_never_end_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    for path in (tmp_path / "pipe.csv", Path("/dev/zero")):
        with pytest.raises(DataError, match="is no regular file"):
            read_bytes(path)
    (tmp_path / "large.csv").write_bytes(bytes(11))
    assert len(read_bytes(tmp_path / "large.csv", 11)) == 11
    with pytest.raises(DataError, match="has more than"):
        read_bytes(tmp_path / "large.csv", 10)


@pytest.mark.parametrize(
    ("name", "words"),
    [("ä" * 128, "longer than 255 bytes"), ("a\0b", "does not exist"), ("a/" * 3000, "too long")],
)
def test_names_that_no_file_has_are_refused(name, words, tmp_path):
    with pytest.raises(DataError, match=words):
        read_bytes(tmp_path / name)


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
    with pytest.raises(DataError, match="leads out of its folder"):
        read_text_inside(folder, "out.csv")
    with pytest.raises(DataError):
        read_text_inside(folder, "loop.csv")


def test_text_may_have_a_byte_order_mark_but_must_be_utf8():
    assert decode_text(b"\xef\xbb\xbfview", "x.csv") == "view"
    with pytest.raises(DataError, match=r"x\.csv, line 2: byte 0xe4 is not UTF-8"):
        decode_text(b"view\ngr\xe4n", "x.csv")


def test_toml_errors_give_the_line():
    with pytest.raises(DataError, match=r"x\.toml is not valid TOML: .*line 2"):
        parse_toml("a = 1\nb = [1,, 2]", "x.toml")


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
    with pytest.raises(DataError, match=words):
        parse_toml(text, "x.toml")


def test_near_names_are_suggested():
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
def test_a_number_that_does_not_serve_is_refused_by_name(content, words):
    with pytest.raises(DataError, match=words) as caught:
        DocumentTable(content, "robot x").number("a", positive=True)
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
