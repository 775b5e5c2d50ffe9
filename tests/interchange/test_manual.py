"""Poses typed from a pendant: what each maker's form means, and what is asked back."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.refusals import raised
from support.rotations import CASES
from support.samples import made_up

from visioncal.core.conventions import POSE_FORMS
from visioncal.core.documents.pendants import pendant_words, read_pose
from visioncal.core.errors import DataError, DriverError
from visioncal.core.transforms import compose
from visioncal.interchange.exports import export
from visioncal.interchange.formats import ImportOptions, PoseImportOptions
from visioncal.interchange.formats.columns import foreign_from
from visioncal.interchange.formats.reading import read_fields
from visioncal.live.drivers.manual import ManualArm
from visioncal.live.drivers.protocols import Arm, RequestingArm
from visioncal.results import Edge

SAMPLE = made_up(5).calibration
SHIFT = np.array([0.4, -0.1, 0.3])


def a_pose(rotation):
    return compose(rotation.as_matrix(), SHIFT)


# By the makers' own definitions, written with scipy's rotations alone.
VECTOR = Rotation.from_rotvec([0.1, -0.2, 3.0])
ABOUT_MOVED, ABOUT_FIXED = (
    Rotation.from_euler(axes, [10, -20, 170], degrees=True) for axes in ("ZYX", "xyz")
)
W_FIRST = Rotation.from_quat([-0.5, 0.5, 0.5, 0.5])
LINES = {
    "p[0.4, -0.1, 0.3, 0.1, -0.2, 3.0]": VECTOR,
    "pose: p[.4,-1e-1,.3,0.1,-0.2,3.0] ": VECTOR,
    "X 400 mm Y -100 mm Z 300 mm RX 0.1 rad RY -0.2 rad RZ 3 rad": VECTOR,
    "{X 400.0, Y -100, Z 300.0, A 10, B -20, C 170}": ABOUT_MOVED,
    "{E6POS: X 400.0,Y -100,Z 300.0,A 10,B -20,C 170,S 6,T 50,E1 0.0,E2 0.0}": ABOUT_MOVED,
    '<Position X="400.0" Y="-100.0" Z="300" A="10.0" B="-20" C="170.0"></Position>': ABOUT_MOVED,
    "X = 400.000 mm, Y = -100 mm, Z = 300 mm,  W = 10 deg, P = -20 deg, R = 170 deg": ABOUT_FIXED,
    "X400.0 Y-100. Z300 W10 P-20 R170": ABOUT_FIXED,
    "X: 400 Y: \N{MINUS SIGN}100 Z: 300 W: 10° P: \N{MINUS SIGN}20° R: 170°": ABOUT_FIXED,
    "[[400,-100,300],[0.5,-0.5,0.5,0.5]]": W_FIRST,
    "CONST robtarget p10:=[[400,-100,300],[0.5,-0.5,0.5,0.5],[0,-1,0,1],[9E9,9E9,9E9,9E9]];": (
        W_FIRST
    ),
    "posx(400, -100, 300, 10, 20, 170)": Rotation.from_euler("ZYZ", [10, 20, 170], degrees=True),
    "X 400 Y -100 Z 300 O 10 A 20 T 170": Rotation.from_euler("ZYZ", [10, 20, 170], degrees=True),
    "POS(X:400 Y:-100 Z:300 A:10 E:20 R:170)": Rotation.from_euler(
        "ZYZ", [10, 20, 170], degrees=True
    ),
    "X 400 Y -100 Z 300 α 10 β -20 γ 170": Rotation.from_euler(  # noqa: RUF001
        "XYZ", [10, -20, 170], degrees=True
    ),
    "x 400 mm y -100 mm z 300 mm roll 0.1 rad pitch -0.2 rad yaw 3 rad": Rotation.from_euler(
        "xyz", [0.1, -0.2, 3.0]
    ),
    "1 0 0 0, 0 0 1 0, 0 -1 0 0, 0.4 -0.1 0.3 1": Rotation.from_euler("x", 90, degrees=True),
    "x_m 0.4 y_m -0.1 z_m 0.3 qx 0.5 qy -0.5 qz 0.5 qw 0.5": Rotation.from_quat(
        [0.5, -0.5, 0.5, 0.5]
    ),
    "0.4, -0.1, 0.3, 0.5, -0.5, 0.5, 0.5": Rotation.from_quat([0.5, -0.5, 0.5, 0.5]),
}


@pytest.mark.parametrize("line", LINES)
def test_a_line_is_read_as_its_maker_defines_it(line):
    found = read_pose(line, "the line")
    # To rounding.
    assert np.abs(found.pose - a_pose(LINES[line])).max() < 1e-12


def about(axis, degrees):
    """A rotation about a coordinate axis, written out."""
    at, cos, sin = "xyz".index(axis), np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn, (j, k) = np.eye(3), ((at + 1) % 3, (at + 2) % 3)
    turn[j, j], turn[j, k], turn[k, j], turn[k, k] = cos, -sin, sin, cos
    return turn


def moving_zyz(first, second, third):
    """The matrix of Comau's eDO_core (vZYZm), term by term."""
    (sa, se, sr), (ca, ce, cr) = (f(np.radians([first, second, third])) for f in (np.sin, np.cos))
    return np.array(
        [
            [ca * ce * cr - sa * sr, -(sa * cr + ca * ce * sr), ca * se],
            [sa * ce * cr + ca * sr, ca * cr - sa * ce * sr, sa * se],
            [-se * cr, se * sr, ce],
        ]
    )


def oat(first, second, third):
    """The quaternion of Kawasaki's O, A, T in the rc_visard manual, as a matrix."""
    (so, sa, st), (co, ca, ct) = (
        f(np.radians([first, second, third]) / 2) for f in (np.sin, np.cos)
    )
    x, y = co * sa * st - so * sa * ct, co * sa * ct + so * sa * st
    z, w = so * ca * ct + co * ca * st, co * ca * ct - so * ca * st
    return Rotation.from_quat([x, y, z, w]).as_matrix()


def fixed_xyz(first, second, third):
    return about("z", third) @ about("y", second) @ about("x", first)


MAKERS_MATRICES = {
    "xarm": fixed_xyz,
    "techman": fixed_xyz,
    "realman": lambda *angles: fixed_xyz(*np.degrees(angles)),
    "rpy-deg": fixed_xyz,
    "mecademic": lambda a, b, c: about("x", a) @ about("y", b) @ about("z", c),
    "kawasaki": oat,
    "comau": moving_zyz,
    "epson": lambda u, v, w: fixed_xyz(w, v, u),
}


@pytest.mark.parametrize("form", MAKERS_MATRICES)
def test_makers_angles_are_composed_as_their_manuals_have_it(form):
    scale, size = (1e3, 1) if form in ("rpy-deg", "realman") else (1, 1e-3)
    angles = np.array([[10, 20, 170], [-75.5, 33.25, 120], [180, 0, 0], [0, 45, -90]])
    for turn in np.radians(angles) if form == "realman" else angles:
        numbers = (400 / scale, -100 / scale, 300 / scale, *turn)
        found = read_pose(" ".join(map(repr, map(float, numbers))), "the line", form)
        expected = compose(MAKERS_MATRICES[form](*turn), size * np.array(numbers[:3]))
        # To rounding.
        assert np.abs(found.pose - expected).max() < 1e-12
    if form == "xarm":
        # The SDK's examples start so: the flange above the table, facing it.
        down = read_pose("300 0 300 180 0 0", "the line", form).pose
        assert np.allclose(down[:3, :3], np.diag([1, -1, -1]), atol=1e-12)


@pytest.mark.parametrize("form", POSE_FORMS)
def test_a_pose_that_is_shown_can_be_typed_back(form):
    pose = compose(Rotation.from_rotvec([0.4, -1.2, 2.0]).as_matrix(), np.array([0.5, -0.2, 0.8]))
    read = read_pose(pendant_words(pose, POSE_FORMS[form]), "the line", form)
    # Half of the last digits that are shown: 0.005 mm, and about 1e-5 rad.
    assert np.abs(read.pose - pose).max() < 2e-5


def test_bare_numbers_are_read_in_the_stated_form():
    for form, rotation in (
        ("ur", Rotation.from_rotvec([0.1, -0.2, 3.0])),
        ("rpy", Rotation.from_euler("xyz", [0.1, -0.2, 3.0])),
    ):
        found = read_pose("0.4 -0.1 0.3 0.1 -0.2 3.0", "the line", form)
        assert np.abs(found.pose - a_pose(rotation)).max() < 1e-12


@pytest.mark.parametrize("form", ["ur", "kuka", "fanuc", "abb", "doosan"])
def test_an_exported_pose_can_be_pasted_back(form):
    for rotation in CASES["any"]:
        matrix = compose(rotation, SHIFT)
        edges = {**SAMPLE.edges, "flange_from_cam": Edge(matrix, np.eye(6))}
        lines = export(replace(SAMPLE, edges=edges), form).splitlines()
        pose = " ".join(line for line in lines if not line.startswith(("#", ";", "!")))
        found = read_pose(pose, "the line")
        assert found.form.name == form
        # Exports are written to the nanometre and to 1e-8 deg.
        assert np.abs(found.pose - matrix).max() < 2e-9


OF_OTHER_PENS = {
    "X 512,34 Y -12,5 Z 800,0 A 10,1 B 0,5 C 180,0": None,
    # All with three decimals: an angle has no thousands.
    "{X 512,340, Y -12,500, Z 800,000, A 10,100, B 0,500, C 180,000}": None,
    "X 512,34\N{NO-BREAK SPACE}mm Y \N{MINUS SIGN}12,5 mm Z 800 mm A 10,1\N{DEGREE SIGN} "
    "B 0,5\N{MASCULINE ORDINAL INDICATOR} C 180\N{RING ABOVE}": None,
    "512,34; -12,5; 800,0; 10,1; 0,5; 180,0": "kuka",
    "512,34 -12,5\t800,0 10,1 0,5 180,0": "kuka",
    "512,34, -12,5, 800, 10,1, 0,5, 180": "kuka",
    "Ｘ　５１２．３４　Ｙ　－１２．５　Ｚ　８００　Ａ　１０．１　Ｂ　０．５　Ｃ　１８０": None,  # noqa: RUF001
    "５１２．３４、－１２．５、８００、１０．１、０．５、１８０": "kuka",  # noqa: RUF001
    "X ٥١٢٫٣٤ Y \N{RIGHT-TO-LEFT MARK}\N{MINUS SIGN}١٢٫٥ Z ٨٠٠ A ١٠٫١ B ٠٫٥ C ١٨٠": None,  # noqa: RUF001
}


@pytest.mark.parametrize("line", OF_OTHER_PENS)
def test_digits_and_decimal_signs_of_other_languages_mean_the_same(line):
    found = read_pose(line, "the line", OF_OTHER_PENS[line])
    assert found.form.name == "kuka"
    expected = Rotation.from_euler("ZYX", [10.1, 0.5, 180.0], degrees=True).as_matrix()
    # To rounding.
    assert np.abs(found.pose - compose(expected, np.array([0.51234, -0.0125, 0.8]))).max() < 1e-12


WRITTEN = st.integers(-900_000, 900_000).map(lambda thousandths: f"{thousandths / 1e3:.3f}")
FORMATS = (
    "X {} Y {} Z {} A {} B {} C {}",
    "{{X {},Y {},Z {},A {},B {},C {}}}",
    "{} {} {} {} {} {}",
    "{};{};{};{};{};{}",
    "{},{},{},{},{},{}",
    "{}, {}, {}, {}, {}, {}",
    "posx({},{},{},{},{},{})",
)


@given(numbers=st.lists(WRITTEN, min_size=6, max_size=6), form=st.sampled_from(FORMATS))
def test_points_are_understood_as_ever_and_commas_as_points_or_not_at_all(numbers, form):
    stated = "doosan" if form.startswith("posx") else "kuka"
    order = "ZYZ" if form.startswith("posx") else "ZYX"
    values = [float(number) for number in numbers]
    rotation = Rotation.from_euler(order, values[3:], degrees=True).as_matrix()
    expected = compose(rotation, 1e-3 * np.array(values[:3]))
    found = read_pose(form.format(*numbers), "the line", stated)
    assert np.abs(found.pose - expected).max() < 1e-12
    line = form.format(*(number.replace(".", ",") for number in numbers))
    digits = {ord(str(digit)): chr(0xFF10 + digit) for digit in range(10)}
    for text in (line, line.translate(digits)):
        try:
            found = read_pose(text, "the line", stated)
        except DataError:
            # Only where commas separate without blanks, too.
            assert "posx" in form or "{},{}" in form
        else:
            assert np.abs(found.pose - expected).max() < 1e-12


@pytest.mark.parametrize(
    ("line", "form", "words"),
    [
        ("512,34,-12,5,800,0", "kuka", "may be decimal, or separate numbers"),
        ("512,34 -12,5 800,0", "kuka", "may be decimal, or separate numbers"),
        # Seven numbers, or six with one comma.
        ("512,34 -12 800 10 0 180", "kuka", "may be decimal, or separate numbers"),
        ("1.234,5 12,5 800,0", "kuka", "may be decimal, or separate numbers"),
        ("X 1,234 Y 2,500 Z 800 A 10 B 0 C 180", None, "1,234 may be decimal, or group thousands"),
        ("X 512,3 Y -12.5 Z 800 A 1 B 2 C 3", None, "decimal commas and decimal points"),
        ("X 1.234,5 Y 2 Z 3 A 1 B 2 C 3", None, "must be a pose"),
        # A soft hyphen may be a minus, or nothing.
        ("X 1 Y \N{SOFT HYPHEN}2 Z 3 A 1 B 2 C 3", None, "must be a pose"),
        ("1 2 3", None, "must be a pose"),
        # Such a line must not take for ever.
        (40 * "1" + "x", None, "must be a pose"),
        ("X 1 mm Y 2 m Z 3 mm A 4 B 5 C 6", None, "must be a pose"),
        (
            "1 2 3 4 5 6",
            None,
            "ur, kuka, fanuc, yaskawa, staubli, doosan, xarm, mecademic, kawasaki",
        ),
        (
            "X 1 Y 2 Z 3 RX 4 RY 5 RZ 6",
            None,
            "a pose of ur, yaskawa, staubli, techman, but must have one",
        ),
        (
            "X 1 Y 2 Z 3 roll 4 pitch 5 yaw 6",
            None,
            "a pose of xarm, rpy, rpy-deg, but must have one",
        ),
        ("X 1 Y 2 Z 3 O 4 A 5 T 6", "comau", "a pose of kawasaki, not of 'comau'"),
        ("1 2 3 4 5 6 7", "kuka", "a pose of ros, not of 'kuka'"),
        (" ".join(map(str, range(16))), None, "must be a pose"),
        ("p[0,43, -0,29, 0,43, 2,4, 0,97, 0,79]", "", "its decimals are behind commas"),
        ("p[0.4, 0, 0, 0, 0, 0]", "kuka", "a pose of ur, not of 'kuka'"),
        ("p[400, 0, 0, 0, 0, 0]", None, "400 m from the base"),
        ("[[400,0,0],[0.5,0.5,0.5,0.4]]", None, "not a quaternion w, x, y, z"),
    ],
)
def test_an_impossible_or_ambiguous_pose_is_refused(line, form, words):
    with pytest.raises(DataError) as caught:
        read_pose(line, "the line", form)
    assert words in str(caught.value)


def a_file(path, rotations, form="kuka", images=True):
    """A pose a line, as a form of the exports writes it, with an image before it."""
    lines = ["# poses of the morning"]
    for at, rotation in enumerate(rotations):
        edges = {**SAMPLE.edges, "flange_from_cam": Edge(compose(rotation, SHIFT), np.eye(6))}
        text = export(replace(SAMPLE, edges=edges), form).splitlines()[-1]
        lines.append(f'img{at}.png; "{text}"' if images else text)
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("form", ["ur", "kuka", "abb", "doosan"])
def test_a_file_with_one_pose_per_line_states_its_form(tmp_path, form):
    rotations = CASES["any"][:4]
    for images in (True, False):
        fields = read_fields(a_file(tmp_path / "poses.txt", rotations, form, images))
        foreign = foreign_from(fields, ImportOptions())
        assert foreign.notes == ()
        # Exports are written to the nanometre and to 1e-8 deg.
        assert np.abs(foreign.robot.poses() - compose(np.array(rotations), SHIFT)).max() < 2e-9
    fields = read_fields(a_file(tmp_path / "b.txt", rotations))
    assert fields.texts["image"][3] == "img3.png"
    foreign_from(fields, ImportOptions(robot=PoseImportOptions(form="kuka")))
    other = ImportOptions(robot=PoseImportOptions(form="fanuc"))
    raised(DataError, "written as KUKA", foreign_from, fields, other)


def test_a_file_of_poses_names_the_line_that_is_wrong(tmp_path):
    path = a_file(tmp_path / "poses.txt", CASES["any"][:3])
    path.write_text(path.read_text() + "img9.png; {X 1, Y 2}\n")
    raised(DataError, r"poses\.txt, line 5.*must be a pose", read_fields, path)
    path.write_text("{X 1,Y 2,Z 3,A 4,B 5,C 6}\np[0.1, 0.2, 0.3, 0, 0, 1]\n")
    raised(DataError, "of several makers: kuka, ur", read_fields, path)
    path.write_text("p[0,0,0,0,0,1]\np[0,0,0,0,0,1] p[0.1,0,0,0,0,1]\n")
    raised(DataError, r"line 2.*must be a pose", read_fields, path)


def asker(lines):
    """What asks, and the questions that it asked."""
    questions, left = [], iter(lines)

    def ask(question):
        questions.append(question)
        line = next(left, None)
        if line is None:
            raise EOFError
        return line

    return ask, questions


def test_a_pose_is_shown_back_and_taken_when_the_person_agrees():
    ask, questions = asker(["{X 400, Y -100, Z 300, A 10, B -20, C 170}", ""])
    arm: Arm = ManualArm(ask)
    state = arm.state()
    wanted = a_pose(Rotation.from_euler("ZYX", [10, -20, 170], degrees=True))
    assert np.abs(state.base_from_flange - wanted).max() < 1e-12
    assert "KUKA" in questions[1]
    assert "x 400.00, y -100.00, z 300.00 mm" in questions[1]
    raised(DriverError, "No typed pose is left", arm.state)


def test_a_person_is_asked_for_each_view_until_it_is_enough():
    ask, questions = asker(["", "p[0.4,0,0,0,0,0]", "", " Q"])
    arm: RequestingArm = ManualArm(ask)
    assert isinstance(arm, RequestingArm)
    assert arm.request(0.0, "View 3 (tilt the camera)").base_from_flange[0, 3] == 0.4
    assert questions[0] == "View 3 (tilt the camera): Enter takes it, q ends: "
    for _ in ("q", "the end of the input"):
        with pytest.raises(EOFError):
            arm.request(0.0, "View 4")


def test_lines_of_a_file_are_a_pose_each_and_none_is_passed_over():
    lines = ["", "p[0.4,0,0,0,0,0]", "p[0.5,0,0,0,0,0]", "p[0.6,0", "p[0.7,0,0,0,0,0]", "q"]
    ask, questions = asker(lines)
    arm = ManualArm(ask, answers=False)
    assert [arm.state().base_from_flange[0, 3] for _ in range(2)] == [0.4, 0.5]
    raised(DriverError, "must be a pose", arm.state)
    assert arm.state().base_from_flange[0, 3] == 0.7
    with pytest.raises(EOFError):
        arm.state()
    assert set(questions) == {""}
    ask, _ = asker(["400 -100 300 10 -20 170"])
    raised(DriverError, "--pose-form", ManualArm(ask, answers=False).state)
