"""Sessions: read without loss, written whole, and refused by file, line and column."""

import json
import re
import shlex
import shutil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.edited import changed as edit
from support.refusals import raised
from support.urdf_arm import URDF

from visioncal.core.errors import DataError
from visioncal.core.types import Need
from visioncal.session import FolderImages, MemoryImages, Session
from visioncal.session.table import parse_csv

TOML = """\
schema = 1
name = "bench"
mount = "eye-in-hand"
target = "board.toml"

[camera]
name = "oak"
resolution = [1280, 800]
matrix = [800, 801.5, 640, 400]
distortion = [0.1, 0, 0, 0, 0]

[robot]
model = "ur10e"
tip = "tool0"
"""
BOARD = 'kind = "checkerboard"\ncolumns = 9\nrows = 6\nsquare_m = 0.025\n'
HEADER = "view,stop,role,image,stamp_s,x_m,y_m,z_m,qx,qy,qz,qw,note"
ROWS = (
    '7,1,,images/a.png,0.10,0.5,-0.1,.3,0,0,0,1,"first, ""dark"""',
    "3,,holdout,images\\b 2.png,1e-1,0.6,0,0.3,0.6,0,0,0.8,",
    "5,2,fit,images/missing.png,,,,,,,,,",
)
TABLE = "\n".join((HEADER, *ROWS)) + "\n"


@pytest.fixture
def folder(tmp_path):
    session = tmp_path / "Prüfstand 1"
    (session / "images").mkdir(parents=True)
    (session / "session.toml").write_text(TOML, encoding="utf-8")
    (session / "views.csv").write_text(TABLE, encoding="utf-8")
    (session / "board.toml").write_text(BOARD, encoding="utf-8")
    (session / "images" / "a.png").write_bytes(b"\x89PNG a")
    (session / "images" / "b 2.png").write_bytes(b"\x89PNG b")
    return session


def refusal(folder):
    with pytest.raises(DataError) as caught:
        Session.load(folder)
    assert caught.value.culprits
    return caught.value


def test_a_session_states_the_content_of_its_folder(folder):
    session = Session.load(folder)
    assert (session.name, session.mount) == ("bench", "eye-in-hand")
    assert session.camera is not None
    assert (session.camera_name, session.camera.model) == ("oak", "brown")
    assert session.resolution == (1280, 800)
    assert session.camera.matrix.tolist() == [800, 801.5, 640, 400]
    assert (session.robot_name, session.declaration.only_robot.tip) == ("ur10e", "tool0")
    assert session.target is not None
    assert session.target.columns == 9
    assert session.columns == tuple(HEADER.split(","))
    assert [view.number for view in session.views] == [7, 3, 5]
    assert [view.holdout for view in session.views] == [False, True, False]
    assert [view.stop for view in session.views] == [1, None, 2]
    assert session.views[1].image == "images/b 2.png"
    assert dict(session.views[0].text) == {"note": 'first, "dark"'}
    assert session.views[0].numbers["z_m"] == 0.3
    assert session.images.read("images/a.png") == b"\x89PNG a"
    assert session.warnings == ()


def test_transforms_come_from_the_rows(folder):
    first, second, third = Session.load(folder).views
    pose = second.base_from_flange()
    assert pose is not None
    assert np.array_equal(pose.translation, [0.6, 0, 0.3])
    expected = Rotation.from_rotvec([2 * np.arctan2(0.6, 0.8), 0, 0])
    # The same rotation by two routes in double precision.
    np.testing.assert_allclose(pose.rotation.as_matrix(), expected.as_matrix(), atol=1e-15)
    assert third.base_from_flange() is None
    assert (first.stamp_s, third.stamp_s) == (0.1, None)
    assert first.cam_from_target() is None
    assert first.joints_rad is None


def test_quaternions_of_two_decimals_are_reported_as_rounded(folder):
    edit(folder, "views.csv", "0.6,0,0,0.8", "0.61,0,0,0.8")
    caught = raised(DataError, "norm is 1.006", Session.load, folder)
    assert "rounded to two decimals, by which a pose turns by up to 0.57 deg" in caught.next_step


def test_a_quaternion_is_stored_as_read_and_normalised_in_the_transform(folder):
    edit(folder, "views.csv", "0.6,0,0,0.8", "0.6003,0,0,0.8")
    view = Session.load(folder).views[1]
    assert view.cell("qx") == "0.6003"
    pose = view.base_from_flange()
    assert pose is not None
    determinant = np.linalg.det(pose.rotation.as_matrix())
    assert determinant == pytest.approx(1.0, abs=1e-14)  # a product of a few rounded numbers


def test_saving_keeps_everything(folder, tmp_path):
    session = Session.load(folder)
    copy = tmp_path / "elsewhere" / "copy"
    session.save(copy)
    again = Session.load(copy)
    assert again.document == session.document
    assert again.target_document == session.target_document
    assert again.columns == session.columns
    for one, other in zip(session.views, again.views, strict=True):
        assert [one.cell(name) for name in session.columns] == [
            other.cell(name) for name in session.columns
        ]
    assert again.images.read("images/b 2.png") == b"\x89PNG b"
    assert not again.images.exists("images/missing.png")
    assert again.digest() == session.digest()
    assert [entry.name for entry in copy.parent.iterdir()] == ["copy"]


def test_a_saved_session_needs_no_other_file(folder, tmp_path):
    shutil.move(folder / "board.toml", tmp_path / "shared board.toml")
    robot = 'schema=1\nconvention="standard"\n[[joint]]\na_m=0\nd_m=1\nalpha_rad=0.5\n'
    (tmp_path / "arm.toml").write_text(robot)
    edit(folder, "session.toml", '"board.toml"', '"../shared board.toml"')
    edit(folder, "session.toml", '"ur10e"', '"../arm.toml"')
    session = Session.load(folder)
    assert [note.partition(" = ")[0] for note in session.notes] == [
        "session.toml: target",
        "session.toml: model",
    ]
    copy = tmp_path / "copy"
    session.save(copy)
    (tmp_path / "shared board.toml").unlink()
    (tmp_path / "arm.toml").unlink()
    again = Session.load(copy)
    assert again.document["target"] == "target.toml"
    assert again.robot_document == session.robot_document
    assert again.digest() == session.digest()


def test_links_out_of_the_folder_are_not_followed(folder, tmp_path):
    shutil.move(folder / "images" / "a.png", tmp_path / "a.png")
    (folder / "images" / "a.png").symlink_to(tmp_path / "a.png")
    images = Session.load(folder).images
    assert not images.exists("images/a.png")
    assert "copy the images into the folder" in images.absence("images/a.png")
    assert images.read("images/b 2.png") == b"\x89PNG b"
    raised(DataError, "leads out", images.read, "images/a.png")
    Session.load(folder).save(tmp_path / "copy")
    assert not (tmp_path / "copy" / "images" / "a.png").exists()
    (tmp_path / "link").symlink_to(folder)
    assert Session.load(tmp_path / "link").images.exists("images/b 2.png")
    shutil.move(folder / "views.csv", tmp_path / "views.csv")
    (folder / "views.csv").symlink_to(tmp_path / "views.csv")
    assert "leads out of its folder" in str(refusal(folder))


def test_nothing_is_overwritten_and_nothing_is_left_half_written(folder, tmp_path):
    session = Session.load(folder)
    full = tmp_path / "full"
    full.mkdir()
    (full / "precious").touch()
    raised(DataError, "exists and is not empty", session.save, full)
    assert [entry.name for entry in full.iterdir()] == ["precious"]

    class Broken(FolderImages):
        def read(self, path):
            raise DataError(f"{path} is on a disk that died.")

    broken = Session(
        session.document,
        session.columns,
        session.views,
        session.target,
        session.target_document,
        Broken(folder),
    )
    raised(DataError, "died", broken.save, tmp_path / "new")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [folder.name, "full"]

    (tmp_path / "empty").mkdir()
    session.save(tmp_path / "empty")
    assert Session.load(tmp_path / "empty").digest() == session.digest()


def test_some_views_alone_stay_as_they_were(folder):
    session = Session.load(folder)
    some = session.only([7, 5])
    assert [(view.number, view.stop, view.image) for view in some.views] == [
        (7, 1, "images/a.png"),
        (5, 2, "images/missing.png"),
    ]
    assert some.views[0].numbers == session.views[0].numbers
    assert session.only([7, 3, 5]).digest() == session.digest()
    caught = raised(DataError, r"views 1-2,9 of .* it has 3,5,7", session.only, [1, 2, 3, 9])
    assert caught.culprits == ("1-2,9",)
    raised(DataError, "no view", session.only, [])


def test_the_need_of_a_task_is_read_and_can_be_overridden(folder, tmp_path):
    plain = Session.load(folder)
    assert plain.need is None
    edit(folder, "session.toml", "[robot]", "[need]\nmm = 0.5\nat = [0.4, 0, 0.1]\n[robot]")
    session = Session.load(folder)
    assert session.need == Need(0.5, None, (0.4, 0.0, 0.1))
    overridden = session.needing(deg=0.2)
    assert overridden.need == Need(0.5, 0.2, (0.4, 0.0, 0.1))
    assert session.needing() is session
    overridden.save(tmp_path / "saved")
    assert Session.load(tmp_path / "saved").need == overridden.need
    assert plain.needing(2).need == Need(2.0)
    # The same was recorded, whatever it is to be good for.
    assert plain.digest() == overridden.digest()


def test_the_digest_sees_facts_and_not_their_spelling(folder, tmp_path):
    digest = Session.load(folder).digest()
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    edit(other, "session.toml", "800, 801.5", "8e2, 801.50")
    edit(other, "session.toml", "[camera]", "# a comment\n[camera]")
    edit(other, "views.csv", "0.10,0.5", "+1.0e-1,00.5")
    edit(other, "views.csv", "\n", "\r\n")
    shutil.move(other / "board.toml", other / "print.toml")
    edit(other, "session.toml", "board.toml", "./print.toml")
    assert Session.load(other).digest() == digest
    session = Session.load(folder)
    held = MemoryImages({name: session.images.read(name) for name in ("images/a.png",)})
    cells = [[view.cell(name) for name in session.columns] for view in session.views]
    # As a recording keeps it: through JSON, images by path.
    document = json.loads(json.dumps(session.document))
    whole = Session.assemble(
        document,
        session.columns,
        cells,
        MemoryImages({**held.files, "images/b 2.png": b"\x89PNG b"}),
        target_document=session.target_document,
    )
    assert whole.digest() == digest
    digests = []
    for name in ("robot", "ptu"):
        copied = tmp_path / name
        shutil.copytree(folder, copied)
        (copied / f"{name}.urdf").write_text(URDF)
        edit(copied, "session.toml", 'model = "ur10e"\ntip = "tool0"', f'model = "{name}.urdf"')
        digests.append(Session.load(copied).digest())
    assert digests[0] == digests[1] != digest
    changed = [
        ("views.csv", "0.6,0,0.3", "0.6000000000000001,0,0.3"),
        ("views.csv", "holdout", "fit"),
        ("views.csv", "dark", "Dark"),
        ("views.csv", "note", "remark"),
        ("session.toml", "801.5", "801.6"),
        ("session.toml", "eye-in-hand", "eye-to-hand"),
        ("board.toml", "0.025", "0.026"),
    ]
    for place, (name, old, new) in enumerate(changed):
        variant = tmp_path / f"variant {place}"
        shutil.copytree(folder, variant)
        edit(variant, name, old, new)
        assert Session.load(variant).digest() != digest, new
    (folder / "images" / "a.png").write_bytes(b"\x89PNG c")
    assert Session.load(folder).digest() != digest


TOML_REFUSALS = [
    ("schema = 1", "schema = 2", "schema is 2, but must be 1"),
    ("schema = 1\n", "", "schema is missing, but must be 1"),
    ("schema = 1\n", 'schema = "1"\n', "schema is '1', but must be 1"),
    ('name = "bench"\n', "", "name is missing"),
    ('"eye-in-hand"', '"hand"', "mount is 'hand', but must be .eye-in-hand. or .eye-to-hand."),
    ("1280, 800", "1280, -800", r"camera\.resolution\[1\] is -800, but must be a whole number"),
    ("800, 801.5", "nan, 801.5", r"camera\.matrix\[0\] is nan, but must be a finite number"),
    ("800, 801.5", "-800, 801.5", r"camera: it has the matrix \[-800.*fx and fy must be above 0"),
    ("matrix =", "matrx =", "has one of matrix and distortion"),
    ("640, 400]", "640]", r"camera\.matrix: it is \[800, 801.5, 640\], but must be \[fx, fy"),
    (
        "[800, 801.5, 640, 400]",
        "[[800, 0.5, 640], [0, 801.5, 400], [0, 0, 1]]",
        r"but must be \[fx, fy, cx, cy\] \[px\], as \[800, 801.5, 640, 400\]",
    ),
    (
        "[800, 801.5, 640, 400]",
        "[800, 0, 0, 0, 801.5, 0, 640, 400, 1]",
        r"but must be \[fx, fy, cx, cy\] \[px\], as \[800, 801.5, 640, 400\]",
    ),
    ("0.1, 0, 0, 0, 0", "0.1, 0, 0, 0", "has 4 coefficients .* needs 5 or 8"),
    ('name = "oak"', 'model = "fisheye"', 'has 5 .* "fisheye" model needs 4'),
    ('name = "oak"', 'intrinsics = "fix"', "camera.intrinsics is 'fix'"),
    ('name = "oak"', "matrix_sigma_px = 1e-300", r"is 1e-300, but .* from 0\.001 to"),
    ('target = "board.toml"\n', "", r"target is missing, but view 7 has an image\. Add target"),
    (
        "[robot]",
        "[prior.flange_from_cam]\nz_m = 81.2\nsigma_m = 1e-3\n[robot]",
        r"cam\.z_m is 81\.2, .* metres, at most 3 on a flange",
    ),
    # Their squares are no numbers, or leave nothing of the images' information.
    *(
        (
            "[robot]",
            f"[{table}\n{key} = {value}\n[robot]",
            rf"{key} is {value}, but must be a number from 1e-07",
        )
        for table, key in (
            ("prior.flange_from_cam]\nz_m = 0.1", "sigma_m"),
            ("prior.flange_from_cam]\nquaternion_xyzw = [0.0, 0.0, 0.0, 1.0]", "sigma_rad"),
            ("instrument]", "sigma_m"),
            ("instrument]", "sigma_rad"),
        )
        for value in ("1e-09", "-1")
    ),
    ("[robot]\nmodel = ", "robot = ", "robot is 'ur10e', but must be a table"),
    ("[robot]", "[need]\nmm = 0\n[robot]", "need.mm is 0, but must be a number above 0"),
    ("[robot]", '[need]\nat = "views"\n[robot]', "need: it says neither mm nor deg: give how near"),
    ("[robot]", '[need]\nmm = 1\nat = "table"\n[robot]', "need.at is 'table', but must be \"v"),
    ("[robot]", "[need]\nmm = 1\nat = [500, 0, 0]\n[robot]", "in the base, in metres"),
    (
        "[robot]",
        "[prior.flange_from_cam]\nz_m = 1.0\n[robot]",
        "prior.flange_from_cam: it has no sigma_m",
    ),
    ("[robot]", "[prior.flange_from_cam]\nsigma_m = 1.0\n[robot]", "cam: it names no component"),
    ('"board.toml"', '{ kind = "x" }', "target is {'kind': 'x'}, but must be a text"),
]


@pytest.mark.parametrize(("old", "new", "words"), TOML_REFUSALS)
def test_a_wrong_session_toml_is_refused_by_field(folder, old, new, words):
    if new.startswith("robot"):
        # A bare key must stand before the tables.
        edit(folder, "session.toml", '[robot]\nmodel = "ur10e"\ntip = "tool0"\n', "")
        edit(folder, "session.toml", "[camera]", 'robot = "ur10e"\n[camera]')
    else:
        edit(folder, "session.toml", old, new)
    error = refusal(folder)
    assert re.search(words, str(error))


@pytest.mark.parametrize("rows", [True, False])
def test_intrinsics_may_be_written_as_cv2_has_them(folder, rows):
    matrix = "[[800, 0, 640], [0, 801.5, 400], [0, 0, 1]]"
    edit(folder, "session.toml", "[800, 801.5, 640, 400]", matrix if rows else
         f"[{matrix.replace('[', '').replace(']', '')}]")  # fmt: skip
    edit(folder, "session.toml", "[0.1, 0, 0, 0, 0]", "[[0.1, 0, 0, 0, 0]]")
    camera = Session.load(folder).camera
    assert camera.matrix.tolist() == [800, 801.5, 640, 400]
    assert camera.distortion.tolist() == [0.1, 0, 0, 0, 0]


def test_all_wrong_fields_are_named_at_once(folder):
    edit(folder, "session.toml", '"bench"', "7")
    edit(folder, "session.toml", "1280, 800", "1280")
    assert refusal(folder).culprits == ("session.toml: name", "session.toml: camera.resolution")


CSV_REFUSALS = [
    (
        ",x_m,y_m,z_m,qx,qy,qz,qw,",
        ",x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg,w,",
        "in x_mm,y_mm,z_mm,rx_deg",
    ),
    ("0.6,0,0.3", "0.6,0,0,3", "line 3: it has 14 fields"),
    (",note", ",role", r"column role is there twice \(columns 3 and 13\)"),
    (",qw,", ",w,", "the columns x_m, .* lack qw"),
    (",z_m,", ",z_mm,", "lack z_m; write z_mm as z_m, in the unit of that name"),
    ("3,,holdout", "3.5,,holdout", r"line 3, column view: '3\.5' must be a whole number"),
    ("3,,holdout", "7,,holdout", r"line 3, column view: 7 is already the view of .*line 2"),
    ("holdout", "test", 'line 3, column role: \'test\' must be a role: "fit", "holdout"'),
    ("0.6,0,0.3", '0.6,"1,100",0.3', "line 3, column y_m: '1,100' may have a decimal comma or"),
    ("0.6,0,0.3", '0.6,"0,1,2",0.3', "line 3, column y_m: '0,1,2' .*such as -1234.5"),
    (",0.10,", ",1e308,", r"1e\+308 s is beyond every recording"),
    ("0.6,0,0.3", "0.6,,0.3", r"line 3, column x_m \.\.\. qw: some are empty"),
    ("0.6,0,0,0.8", "0.6,0,0,0.9", r"line 3, column qx \.\.\. qw: .*norm is 1\.08167, but must"),
    ("0.6,0,0,0.8,", "0.6,0,0,0.8", "line 3: it has 12 fields, but the header has 13 columns"),
    ("1e-1,0.6,0,0.3", "1e-1,0,6,0,0.3", "14 fields, .* 0,6 is two fields: write 0.6"),
    ("images\\b 2.png", "..\\b.png", "line 3, column image: the path .* leaves the session"),
    ("images\\b 2.png", "", "line 3, column image: it is empty, and the row has neither"),
    ('"first, ""dark"""', '"first', r"views\.csv, line 2"),
    (",note", ",", "column 13 has no name"),
    ("view,", "number,", "header: the column view, .*, is missing"),
    ("note\n", "note\n-,,,,s,m,m,m,,,,,\n", "line 2, column view"),
]


@pytest.mark.parametrize(("old", "new", "words"), CSV_REFUSALS)
def test_a_wrong_views_csv_is_refused_by_line_and_column(folder, old, new, words):
    edit(folder, "views.csv", old, new)
    error = refusal(folder)
    assert re.search(words, str(error))
    assert "views.csv" in error.culprits[0]


def test_a_fault_of_many_rows_is_reported_once(folder):
    rows = [f"{k},,,images/{k}.gif,1,,,,,,,,\n" for k in range(12)]
    (folder / "views.csv").write_text(HEADER + "\n" + "".join(rows) + "x,,,a.png,1,,,,,,,,\n")
    error = refusal(folder)
    lines = error.message.splitlines()
    assert len(lines) == len(error.culprits) == 2
    assert "line 2, column image: the image 'images/0.gif'" in lines[0]
    assert lines[0].endswith("And 11 more, up to views.csv, line 13, column image.")
    assert "line 14, column view: 'x' must be a whole number" in lines[1]


@pytest.mark.parametrize("name", ["session.toml", "views.csv"])
def test_a_missing_or_empty_file_is_named(folder, name):
    (folder / name).write_text("")
    assert name in refusal(folder).message
    (folder / name).unlink()
    assert f"{name} does not exist" in refusal(folder).message


@pytest.mark.parametrize("separator", [";", "\t"])
def test_the_separators_and_commas_of_spreadsheets_are_read(folder, separator):
    digest = Session.load(folder).digest()
    table = parse_csv((folder / "views.csv").read_text(), "views.csv")
    lines = [
        separator.join(re.sub(r"^(-?\d+)\.(\d+)$", r"\1,\2", cell) for cell in cells)
        for cells in (table.columns, *table.rows)
    ]
    (folder / "views.csv").write_text("\n".join(lines))
    assert Session.load(folder).digest() == digest
    # Where cells at the right and below were filled once, empty ones are written.
    margin = [*(line + 2 * separator for line in lines), separator * (len(table.columns) + 1)]
    (folder / "views.csv").write_text("\n".join(margin))
    assert Session.load(folder).digest() == digest


def test_a_folder_that_is_no_session_is_refused(tmp_path):
    raised(DataError, "nowhere.session.toml does not exist", Session.load, tmp_path / "nowhere")
    for name in ("notes.txt", "calibration.json", "recording.rrd"):
        (tmp_path / name).write_text("{}", encoding="utf-8")
    raised(DataError, "notes.txt must be the folder", Session.load, tmp_path / "notes.txt")
    (pictures := tmp_path / "two words").mkdir()
    caught = raised(DataError, "two words.session.toml does not exist", Session.load, pictures)
    words = shlex.split(caught.next_step.partition("Run: visioncal ")[2])
    assert words[:3] == ["convert", str(pictures), f"{pictures}-session"]
    assert words[-2:] == ["doctor", words[2]]
    for path in (tmp_path, tmp_path / "calibration.json"):
        caught = raised(DataError, "but is a result", Session.load, path)
        assert f"name {tmp_path / 'recording.rrd'}" in caught.next_step


def test_a_byte_order_mark_and_other_line_ends_are_read(folder):
    digest = Session.load(folder).digest()
    for name in ("session.toml", "views.csv"):
        text = (folder / name).read_text(encoding="utf-8").replace("\n", "\r\n")
        (folder / name).write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert Session.load(folder).digest() == digest


WARNINGS = [
    ("session.toml", "[camera]", 'targt = "x"\n[camera]', "targt is not a known .* mean target"),
    ("session.toml", "ur10e", "kuka", "robot.model: There is no robot named 'kuka'"),
    ("session.toml", "[robot]", "[prior.flange_to_cam]\nz_m=1\nsigma_m=1\n[robot]", "flange_from"),
    ("views.csv", "note", "stamps_s", "stamps_s .* kept as text. Did you mean stamp_s"),
]


@pytest.mark.parametrize(("name", "old", "new", "words"), WARNINGS)
def test_suspicious_values_are_reported_and_kept(folder, name, old, new, words):
    edit(folder, name, old, new)
    session = Session.load(folder)
    assert len(session.warnings) == 1
    assert re.search(words, session.warnings[0])
    session.save(folder.parent / "copy")
    assert Session.load(folder.parent / "copy").digest() == session.digest()


@pytest.mark.parametrize("extra", ["point", "meas_x_m,meas_y_m,meas_z_m"])
def test_touches_and_readings_need_no_image(folder, extra):
    cells = "tip" if extra == "point" else "1,2,3"
    (folder / "views.csv").write_text(f"view,{extra}\n1,{cells}\n")
    edit(folder, "session.toml", 'target = "board.toml"\n', "")
    assert Session.load(folder).target is None


cells = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
finite = st.floats(-1e10, 1e10)


@settings(deadline=None, max_examples=20)  # a busy disk takes its time to flush
@given(rows=st.lists(st.tuples(cells, finite), min_size=1, max_size=5))
def test_any_text_and_any_number_survive(tmp_path_factory, rows):
    columns = ("view", "note", "stamp_s", "point")
    texts = [[str(k), note, repr(stamp), "p"] for k, (note, stamp) in enumerate(rows)]
    document = {"schema": 1, "name": "n", "mount": "eye-to-hand"}
    session = Session.assemble(document, columns, texts, MemoryImages({}))
    copy = tmp_path_factory.mktemp("any") / "copy"
    session.save(copy)
    again = Session.load(copy)
    for view, (note, stamp) in zip(again.views, rows, strict=True):
        assert (view.cell("note"), view.stamp_s) == (note, stamp)
    assert again.digest() == session.digest()


def test_a_session_is_not_saved_as_a_folder_that_looks_like_a_recording(folder, tmp_path):
    with pytest.raises(DataError, match="saved as a folder") as refused:
        Session.load(folder).save(tmp_path / "copy.rrd")
    assert "visioncal convert FOLDER copy.rrd" in refused.value.next_step
    assert not (tmp_path / "copy.rrd").exists()


def test_a_shared_column_that_names_two_cameras_is_refused(folder):
    edit(folder, "views.csv", "note", "camera")
    edit(folder, "views.csv", "0.8,", "0.8,left")
    assert "names first, " in refusal(folder).message


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ({"matrix": None, "matrix_sigma_px": None}, ""),
        ({1: 2}, ""),
        ({"matrix_sigma_px": 10**400}, "matrix_sigma_px is 1000.*, but must be a number"),
    ],
)
def test_a_camera_of_a_mapping_may_leave_values_out(camera, words):
    corners = [([0, 1], [[1.0, 2.0], [3.0, 4.0]])] * 3
    poses = np.tile(np.eye(4), (3, 1, 1))

    def build() -> Session:
        return Session.from_corners(
            corners, poses, "charuco_9x6_30mm", (1280, 800), mount=np.str_("eye-in-hand"),
            camera={"resolution": (1280, 800), **camera},
        )  # fmt: skip

    if words:
        raised(DataError, words, build)
    else:
        assert build().mount == "eye-in-hand"


def test_a_schema_as_a_text_is_refused_in_words(folder):
    path = folder / "session.toml"
    path.write_text(path.read_text("utf-8").replace("schema = 1", 'schema = "1"'), "utf-8")
    raised(DataError, "schema is '1', but must be 1", Session.load, folder)
