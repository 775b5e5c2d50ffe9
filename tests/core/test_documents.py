"""Reading files of others as data: what they hold is read, what they would do is not done."""

import io
import math
import pickle
import zipfile
from contextlib import suppress
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io.matlab import MatlabOpaque
from support.refusals import raised

from visioncal.core.documents.jsons import parse_json, parse_stored, read_arrays, read_json
from visioncal.core.documents.structured import parse_yaml, read_opencv, read_xml, read_yaml
from visioncal.core.documents.tables import read_table
from visioncal.core.documents.values import as_numbers
from visioncal.core.errors import DataError
from visioncal.core.files import read_bytes


@pytest.fixture
def file(tmp_path):
    def write(name, content):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),  # YAML 1.1 itself takes it for text
        ("010", 10),
        ("1_000", "1_000"),
        ("~", None),
        ("Yes", True),
        (".Inf", math.inf),
        ("2026-11-20", "2026-11-20"),
        ("9" * 30, float("9" * 30)),
        ("{a: [1, {b: c}]}", {"a": [1, {"b": "c"}]}),
        ("", None),
    ],
)
def test_yaml_values_are_read(text, value):
    assert parse_yaml(text, "it") == value


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: 1\nb: !!python/object/apply:os.getcwd []", "line 2: the tag 'python/object/apply"),
        ("a: !!python/name:os.system x", "the tag"),
        ("a: !local x", "the tag"),
        ("a: 1\nb: 2\na: 3", "line 3: 'a' must be a key that occurs once"),
        ("a: &a [*a]", "not YAML"),
        ("[" * 200, "not YAML"),
        ("[" * 100_000, "not YAML"),
        ("- " * 200 + "1", "nested deeper"),
        ("a: [1, 2", "not YAML"),
        ("a: !!opencv-matrix [1, 2]", "not YAML"),
        ("a: !!int x", "not YAML"),
        ("a: b: c", "line 1 is not YAML"),
        ("? [1]\n: 2", "line 1: a list of 1 must be a key"),
        (
            "m: !!opencv-matrix {rows: 2, cols: 2, dt: d, data: [1, 2, 3]}",
            "3 numbers are no matrix",
        ),
        ("m: !!opencv-matrix {rows: 1, cols: 1, dt: x, data: [1]}", "of the type 'x'"),
        ("a: \x01", "not YAML"),
    ],
)
def test_malformed_yaml_is_refused(text, words):
    raised(DataError, words, parse_yaml, text, "it")


def test_aliases_cost_nothing(file):
    lines = ["a: &a [lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    lines += [f"{b}: &{b} [*{a}, *{a}, *{a}, *{a}, *{a}]" for a, b in pairwise("abcdefghi")]
    with pytest.raises(DataError, match="more than 1,000,000 values"):
        read_yaml(file("laughs.yaml", "\n".join(lines)))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": 1, "a": 2}', "the key 'a' occurs twice"),
        ("[" * 100_000, "deep|not JSON"),
        ("[" * 60 + "]" * 60, "nested deeper"),
        ("[" + "1," * 1_200_000 + "1]", "more than 1,000,000 values"),
        ("[1,\n2,\n}", "line 3"),
        ("", "not JSON"),
        ('{"\\ud800": 1}', "half of a letter"),
        ('["a\\uDFFFb"]', "half of a letter"),
    ],
)
def test_malformed_json_is_refused(text, words):
    raised(DataError, words, parse_json, text, "it")


def test_pairs_of_utf_16_in_json_are_letters():
    assert parse_json('["\\uD83D\\ude00"]', "it") == ["\N{GRINNING FACE}"]


def test_json_numbers_that_are_not_finite_are_read():
    value = parse_json("[NaN, -Infinity, 1e999, %s, null]" % ("7" * 5000), "it")
    assert math.isnan(value[0])
    assert value[1:4] == [-math.inf, math.inf, math.inf]
    assert math.isnan(as_numbers(value, "it")[4])


@given(st.binary(max_size=200))
def test_any_bytes_give_a_value_or_a_message(data):
    text = data.decode("latin-1")
    for parse in (parse_json, parse_yaml):
        # Anything but a DataError fails the test.
        with suppress(DataError):
            parse(text, "it")


def test_xml_has_no_document_type(file):
    for inner in ('<!ENTITY a "b">', '<!ENTITY a SYSTEM "file:///etc/hostname">'):
        path = file("a.xml", f"<!DOCTYPE r [{inner}]><r>&a;</r>")
        raised(DataError, "document type", read_xml, path)
    raised(DataError, "nested deeper", read_xml, file("deep.xml", "<a>" * 100 + "</a>" * 100))
    raised(DataError, r"is not XML.*line 2", read_xml, file("cut.xml", "<a>\n<b>"))
    root = read_xml(file("good.xml", "<a>x<!-- no --><b c='1'> 2 </b>y</a>"))
    assert (root.findtext("b"), root.find("b").attrib) == (" 2 ", {"c": "1"})


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_files_of_opencv_are_read_without_it(tmp_path, suffix):
    path = tmp_path / f"stored.{suffix}"
    # OpenCV's JSON has no notation of its own for what is not finite.
    odd = [1.0, 2.0] if suffix == "json" else [np.inf, np.nan]
    matrix = np.array([[1.5, -2e-12, odd[0]], [1 / 3, odd[1], 7]])
    image = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("matrix", matrix)
    storage.write("image", image)
    storage.write("count", 3)
    storage.write("name", "a lens")
    storage.release()
    read = read_opencv(path)
    np.testing.assert_array_equal(read["matrix"], matrix)
    np.testing.assert_array_equal(read["image"], image)
    assert (read["count"], read["name"]) == (3, "a lens")


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["<f8", ">f4", "<i2", "|u1", "|b1", "<U5", "|S3"])
def test_files_of_numpy_are_read_without_it(tmp_path, dtype, order):
    array = np.asarray(np.arange(6).reshape(2, 3) % 2, dtype=dtype, order=order)
    np.save(tmp_path / "a.npy", array)
    np.savez_compressed(tmp_path / "a.npz", array=array, scalar=array[0, 0])
    np.testing.assert_array_equal(read_arrays(tmp_path / "a.npy")["matrix"], array)
    arrays = read_arrays(tmp_path / "a.npz")
    np.testing.assert_array_equal(arrays["array"], array)
    assert arrays["scalar"].shape == ()


class Executed:
    """What must not be loaded."""

    def __reduce__(self):
        return (exec, ("raise SystemExit('a pickle was executed')",))


def test_pickles_are_not_opened(file, tmp_path):
    np.save(tmp_path / "a.npy", np.array([Executed()], dtype=object), allow_pickle=True)
    raised(DataError, "Python objects are not read", read_arrays, tmp_path / "a.npy")
    np.savez(tmp_path / "a.npz", a=np.array([Executed()], dtype=object))
    raised(DataError, "Python objects are not read", read_arrays, tmp_path / "a.npz")
    raised(DataError, "no arrays", read_arrays, file("b.npz", pickle.dumps(Executed())))


def test_objects_of_matlab_have_nothing_inside(file, monkeypatch):
    """A table within a structure is named as one."""
    table = MatlabOpaque(np.zeros(1, [(name, "O") for name in ("s0", "s1", "s2", "arr")]))
    run = np.zeros((1, 1), [("poses", "O")])
    run[0, 0] = (table,)
    content = {"run": run, "none": np.array(None, dtype=object)}
    monkeypatch.setattr("scipy.io.loadmat", lambda _: content)
    raised(DataError, "a table or other objects of MATLAB", read_arrays, file("a.mat", b"0"))


def test_a_zip_bomb_is_not_unpacked(file):
    stored = io.BytesIO()
    with zipfile.ZipFile(stored, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", b"\0" * 60_000_000)
    assert len(stored.getvalue()) < 100_000
    with pytest.raises(DataError, match="unpacks to more than 50 MB"):
        read_arrays(file("bomb.npz", stored.getvalue()))


TABLES = {
    "comma": "a,b\n1,2\n3,4\n",
    "semicolon with decimal comma": "a;b\n1,0;2,0\n3,0;4,0\n",
    "tab with decimal comma": "a\tb\n1,0\t2,0\n3,0\t4,0\n",
    "commas with decimal commas in quotes": 'a,b\n"1,0",2\n3,"4,00"\n',
    "separator named, as Excel does": "sep=;\na;b\n1,0;2,0\n3,0;4,0\n",
    "tab": "a\tb\n1\t2\n3\t4\n",
    "blanks": "a  b\n1   2\n 3 4\n",
    "comment as header": "# a b\n1 2\n\n# in between\n3 4\n",
    "comment of another kind": "// a b\n1 2\n3 4\n",
    "comment with words before its header": "% of the robot: a, b\n1,2\n3,4\n",
    "mark and line ends of Windows": "\ufeffa,b\r\n1,2\r\n3,4\r\n",
    "quoted": '"a", "b"\n"1", 2\n3,"4"\n',
    "a comma at the end of the first row": "# a, b\n1,2,\n3,4\n",
    "empty rows and columns": "a;b;;\n1;2;;\n;;;\n3;4;;\n;;;\n",
}


@pytest.mark.parametrize("text", TABLES.values(), ids=TABLES.keys())
def test_tables_of_many_forms_are_read(file, text):
    table = read_table(file("a.csv", text))
    assert table.columns == ("a", "b")
    assert [[float(name) for name in row] for row in table.rows] == [[1, 2], [3, 4]]


def test_columns_without_names_are_numbered(file):
    for text in ("1 nan\n3 4\n", "left 2\n3 4\n", "# of three words\n3 4\n", "# 1 2\n3 4\n"):
        table = read_table(file("a.txt", text))
        assert (table.columns, table.has_header) == (("1", "2"), False)
        assert table.rows[-1] == ("3", "4")
        assert table.place(len(table.rows) - 1) == "a.txt, line 2"
    table = read_table(file("b.csv", "a,,c\n1,2,3\n"))
    assert (table.columns, table.has_header) == (("a", "column_2", "c"), True)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        # Two rows or more below an empty line may be a program's results.
        ("a,b,c\n" + 12 * "1,2,3\n" + "\n1,2\n", r"line 15: 2 cells, but must be 3"),
        ("a,b\n1,2,3\n", r"line 2: 3 cells, but must be 2.*semicolons"),
        ("a,a\n1,2\n", "two columns are named 'a'"),
        ("a,b\n", "a header and no rows"),
        ("# only words\n", "has no rows"),
        ("1," * 1_200_000, "more than 1,000,000 values"),
    ],
)
def test_malformed_tables_are_refused(file, text, words):
    raised(DataError, words, read_table, file("a.csv", text))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "cp1252", "utf-16"])
def test_tables_are_read_as_spreadsheets_write_them(file, encoding):
    table = read_table(file("a.csv", "Größe;A [°]\n1,5;2\n".encode(encoding)))
    assert table.columns == ("Größe", "A [°]")
    assert [*table.rows[0]] == ["1.5", "2"]


def test_tables_are_read_as_a_chinese_spreadsheet_writes_them(file):
    table = read_table(file("a.csv", "序号,位置X(mm),姿态RX(°)\n1,5.5,2\n".encode("gbk")))
    assert table.columns == ("序号", "位置X(mm)", "姿态RX(°)")


def test_binary_and_too_large_files_are_refused(file, tmp_path):
    raised(DataError, "line 2: a NUL byte", read_json, file("a.json", b"[\n\0]"))
    # A hole in the file: nothing is written to the disk.
    with (tmp_path / "large.csv").open("wb") as large:
        large.truncate(60_000_000)
    raised(DataError, "more than 50 MB", read_bytes, tmp_path / "large.csv")


def npy(descr, shape, data=b""):
    """An array with this header, in the format's first version."""
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


def npz(data, packing=zipfile.ZIP_STORED, name="a.npy"):
    stored = io.BytesIO()
    with zipfile.ZipFile(stored, "w", packing) as archive:
        archive.writestr(name, data)
    return stored.getvalue()


def changed(data, mark, offset, value):
    """The bytes with one of them replaced, so far behind the last occurrence of a mark."""
    at = data.rindex(mark) + offset
    return data[:at] + bytes([value]) + data[at + 1 :]


WHOLE = npz(npy("<f8", "(2,)", bytes(16)))
HOSTILE = {
    "one-byte float.npy": (npy("<f1", "(3,)", b"abc"), "no (arrays|numbers)"),
    "cut.npy": (npy("<f8", "(3,)", bytes(19)), "no arrays"),
    "hidden size.npy": (npy("<f8", f"({10**11}, {10**11}, 0)"), "no arrays"),
    "texts of nothing.npy": (npy("<U0", "(10000000000,)"), "more than 1,000,000 values"),
    "open shape.npy": (npy("<i8", "(3"), "no arrays"),
    # Fields of the entry in the archive's directory: flags, packing, and where the file begins.
    "encrypted.npz": (changed(WHOLE, b"PK\x01\x02", 8, 1), "no arrays"),
    "beyond its end.npz": (changed(WHOLE, b"PK\x01\x02", 45, 9), "no arrays"),
    "wrong sum.npz": (changed(WHOLE, b"PK\x01\x02", 16, 1), "no arrays"),
    "cut.npz": (WHOLE[:-30], "no arrays"),
    "array inside.npz": (npz(npy("<f1", "(3,)", b"abc")), "no (arrays|numbers)"),
    "half a row.yml": (
        "a: !!opencv-matrix {rows: 1.5, cols: 2, dt: d, data: [1, 2, 3]}",
        "are no matrix",
    ),
    "odd number.xml": (
        "<s><a type_id='opencv-matrix'><rows>1</rows><cols>1</cols><data>1_0</data></a></s>",
        "must be numbers, but is '1_0'",
    ),
    "attributes.xml": (
        f"<s {' '.join(f'a{at}={chr(34)}1{chr(34)}' for at in range(1000))}/>",
        "s has 1000 attributes",
    ),
    "numbers.xml": (b"<s><a>" + b"1 " * 1_200_000 + b"</a></s>", "more than 1,000,000 values"),
    "numbers in parts.xml": (
        b"<s>" + (b"<a>" + b"1\n" * 300_000 + b"</a>") * 4 + b"</s>",
        "more than 1,000,000 values",
    ),
}
READERS = {".npy": read_arrays, ".npz": read_arrays, ".yml": read_opencv, ".xml": read_opencv}


@pytest.mark.parametrize("name", HOSTILE)
def test_documents_made_to_break_a_reader_are_refused(file, name):
    content, words = HOSTILE[name]
    path = file(name.replace(" ", "_"), content)
    raised(DataError, words, READERS[path.suffix], path)


def test_only_line_ends_end_a_row(file):
    cells = ["a\x0bb", "a\x0cb", "a\x1cb", "a\x85b", "a\u2028b"]
    text = "note,number\n" + "".join(f"{cell},{at}\r" for at, cell in enumerate(cells))
    table = read_table(file("a.csv", text))
    assert [row[0] for row in table.rows] == cells
    assert table.place(4) == "a.csv, line 6"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"rows": [{"value": 1e300}]}', r"value is 1e\+300, but must be at most"),
        ('{"value": NaN}', "must be at most"),
        ("[]", "must be a table"),
        ("[" * 100000, "nested deeper"),
        ('{"schema": ' + "9" * 6000 + "}", "must be at most"),
    ],
)
def test_stored_documents_must_have_numbers_of_a_cell(text, words):
    raised(DataError, words, parse_stored, text, "a.json")
