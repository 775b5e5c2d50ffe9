"""Tables as editors and spreadsheets leave them: the message begins with the likeliest cause."""

import pytest
from support.commands import visioncal


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables") / "cell"
    visioncal("simulate", folder, "--no-images", "--views", 6).good()
    return folder


@pytest.fixture
def session(written, tmp_path):
    """A session whose tables may be changed."""
    for file in written.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: f"{text.splitlines()[0]}\n{text}", "line 2: it repeats the header."),
        (lambda text: text + text, "line 8: it repeats the header."),
        (lambda text: text.replace(".", ","), "line 2: its decimals are behind commas"),
        (lambda text: text.replace("\n3,", "\n# typed by hand\n3,"), "line 5: it is a comment"),
        (lambda text: f"# log of Monday\n{text}", "the first line is a comment"),
        (lambda text: text.replace("x_m", "X_M", 1), "write X_M as x_m, in small letters"),
    ],
    ids=["header twice", "table twice", "commas", "comment", "comment above", "capitals"],
)
def test_the_cause_of_a_broken_table_comes_first(session, change, said):
    table = session / "views.csv"
    table.write_text(change(table.read_text()))
    error = visioncal("doctor", session).refused("views.csv", said).err
    # One cause is one line, and no cell is complained of.
    assert "must be a finite number" not in error


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
def test_unmarked_letters_of_two_bytes_are_named(session, encoding):
    table = session / "views.csv"
    table.write_bytes(table.read_text().encode(encoding))
    name = encoding.upper().replace("-LE", "LE").replace("-BE", "BE")
    visioncal("doctor", session).refused("UTF-16 without a mark", f"iconv -f {name}")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('name = "cell"', 'name = "cell'), ('The text of line 2 has no end: put " behind it.',)),
        (('name = "cell"', 'name = "a"\nname = "b"'), ("line 3 is there already: delete one",)),
        (('name = "cell"', "name = 2026-11-20"), ("name is 2026-11-20, but must be a text",)),
    ],
    ids=["open quote", "key twice", "date"],
)
def test_a_mistake_in_a_description_is_named(session, change, said):
    file = session / "session.toml"
    file.write_text(file.read_text().replace(*change))
    assert "datetime" not in visioncal("doctor", session).refused(*said).err
