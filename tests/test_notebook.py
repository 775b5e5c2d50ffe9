"""What a notebook shows, and the example notebook's cells."""

import ast
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from support.refusals import raised
from support.samples import made_up

import visioncal
from visioncal.core.errors import DataError

NOTEBOOK = Path(__file__).with_name("cookbook") / "a_notebook.ipynb"
# A notebook shows a value's first lines; nobody reads more.
LINES, LETTERS = 12, 1500


def values_of(notebook: Path) -> list[object]:
    """Runs a notebook's cells in the current folder; the last value of each, as it would show."""
    names: dict[str, object] = {}
    values = []
    for cell in json.loads(notebook.read_text("utf-8"))["cells"]:
        if cell["cell_type"] != "code":
            continue
        tree = ast.parse("".join(cell["source"]))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, notebook.name, "exec"), names)
        if last is not None:
            values.append(eval(compile(ast.Expression(last.value), notebook.name, "eval"), names))
    return values


@pytest.mark.slow
def test_the_cells_of_the_example_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    session, checkup, calibration, verdict, place, views, again, by_corners, holds = values_of(
        NOTEBOOK
    )
    assert checkup.is_sound
    assert verdict is calibration.verdict
    assert (verdict.status, by_corners, holds) == ("good", "good", True)
    assert len(views) == len(session.views)
    # The same images and lens; without joint angles the poses are those that were reported, and the
    # place is known to some 0.1 mm.
    assert np.linalg.norm(again.transforms["flange_from_cam"].translation - place) < 2e-4


def test_values_are_short_in_a_console_and_cards_in_a_notebook():
    sample = made_up()
    for value in (sample.session, sample.calibration, sample.calibration.verdict):
        text = repr(value)
        assert len(text.splitlines()) <= LINES
        assert len(text) <= LETTERS
    for value in (sample.session, sample.calibration, sample.calibration.verdict):
        card = value._repr_html_()
        assert card.startswith("<div")
        # The session's name, and what its views say, come from anywhere.
        assert "<1>" not in card
        assert "<its>" not in card


def test_every_listed_name_exists():
    assert dir(visioncal) == sorted(visioncal.__all__)
    for name in visioncal.__all__:
        assert getattr(visioncal, name) is not None


def test_an_unknown_name_suggests_the_nearest():
    transforms = made_up().calibration.transforms
    with pytest.raises(KeyError, match="Did you mean flange_from_cam"):
        transforms["flange_from_camera"]
    raised(DataError, "base_from_target", made_up().calibration.covariance, "base_from_board")
    assert transforms.get("flange_from_camera") is None


def test_arrays_that_do_not_match_are_refused():
    poses = np.tile(np.eye(4), (3, 1, 1))
    image = np.zeros((8, 8), dtype=np.uint8)
    with pytest.raises(DataError, match=r"^2 images and 3 poses"):
        visioncal.Session.from_arrays([image] * 2, poses, "charuco_9x6_30mm")
    with pytest.raises(DataError, match=r"images\[0\] is an array of float64.* image of uint8"):
        visioncal.Session.from_arrays([0.5 * image] * 3, poses, "charuco_9x6_30mm")
    with pytest.raises(DataError, match=r"There is no argument named .robott") as caught:
        visioncal.Session.from_arrays([image] * 3, poses, "charuco_9x6_30mm", robott="ur5e")
    assert caught.value.next_step == "Did you mean robot?"
    with pytest.raises(DataError, match="There are no views"):
        visioncal.Session.from_arrays([], np.zeros((0, 4, 4)), "charuco_9x6_30mm")


BOARD = "charuco_9x6_30mm"
POSES = np.stack([np.eye(4)] * 3)
POSES[:, :3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
POSES[:, :3, 3] = 0.4, 0.1, 0.5
SEEN = [(np.arange(8), np.arange(16.0).reshape(8, 2))] * 3


def from_corners(corners, poses=POSES, **more):
    return visioncal.Session.from_corners(corners, poses, BOARD, (640, 480), **more)


def test_views_without_corners_keep_their_place():
    session = from_corners([SEEN[0], (None, None), SEEN[2]])
    assert [view.has_corners for view in session.views] == [True, False, True]


@pytest.mark.parametrize(
    ("corners", "words"),
    [
        (SEEN[:2], r"^2 corners and 3 poses"),
        ([SEEN[0], (SEEN[0][0][1:], SEEN[0][1]), SEEN[2]], r"corners\[1\]: 7 ids and .*\(8, 2\)"),
        ([(np.arange(8) + 0.5, SEEN[0][1]), *SEEN[1:]], r"corners\[0\]: its ids are no whole"),
        ([(np.arange(8) + 99, SEEN[0][1]), *SEEN[1:]], r"^corners\[0\], ids\[0\]: .*no point 99"),
        (
            [SEEN[0], (np.arange(8) % 7, SEEN[0][1]), SEEN[2]],
            r"^corners\[1\], ids\[7\]: .*ids\[0\]",
        ),
        (
            [SEEN[0], (np.arange(8), SEEN[0][1] * np.nan), SEEN[2]],
            r"corners\[1\]: px has numbers that are",
        ),
    ],
)
def test_malformed_corners_are_refused_by_array_and_index(corners, words):
    assert "corners.csv" not in str(raised(DataError, words, from_corners, corners))


@pytest.mark.parametrize(
    ("spoilt", "words"),
    [
        (POSES.swapaxes(1, 2), r"\[0\] .* transposed"),
        (POSES * [[[-1], [-1], [-1], [1]]], r"\[0\] .* reflection"),
        ([POSES[0], POSES[0] * np.nan, POSES[0]], r"\[1\] .* not finite"),
        ([POSES[0], POSES[0] + 0.1 * np.eye(4, k=1), POSES[0]], r"\[1\] .* right angles"),
        (POSES[:, :3], r"\[0\] .* shape is \(3, 4\)"),
    ],
)
def test_poses_that_are_no_rigid_transforms_are_refused(spoilt, words):
    raised(DataError, rf"^base_from_flange{words}", from_corners, SEEN, spoilt)


def test_joint_angles_of_other_views_are_refused_and_rounded_rotations_are_not():
    with pytest.raises(DataError, match=r"^q has the shape \(2, 6\) beside 3 poses"):
        from_corners(SEEN, q=np.zeros((2, 6)))
    assert len(from_corners(SEEN, [RigidTransform.from_matrix(pose) for pose in POSES]).views) == 3
    # As a print with three decimals has them.
    assert len(from_corners(SEEN, POSES.round(3)).views) == 3
