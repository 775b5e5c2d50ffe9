"""A fault is named first, and what the printed command does mends what was named.

Cells of corners on disk, one fault each: the commands are followed word for word, the copy is
calibrated, and must know the camera as well as its sigma says.
"""

import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from support.cells import showing
from support.edited import Rows, edit_rows
from support.following import follow
from support.marks import slow

import visioncal
from visioncal.core.errors import DegenerateError
from visioncal.results import Calibration
from visioncal.session.columns import POSE
from visioncal.simulation import CellOptions, SimulatedCell, cell_session, simulate

SOUND = CellOptions(views=20, pixel_sigma_px=0.1, seed=4)


def rows_of(change: Callable[[Rows], Rows]) -> Callable[[Path], None]:
    return lambda folder: edit_rows(folder, change)


def document_of(change: Callable[[dict], object]) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        path = folder / "session.toml"
        document = tomllib.loads(path.read_text("utf-8"))
        change(document)
        path.write_text(tomli_w.dumps(document), "utf-8")

    return edit


def each(
    change: Callable[[np.ndarray, Rotation], tuple[np.ndarray, np.ndarray]],
    some: Sequence[int] = (),
):
    """Changes the position and rotation of some rows or all, to numbers of them."""

    def changed(rows: Rows) -> Rows:
        for row in [rows[at] for at in some] or rows:
            numbers = np.array([float(row[name]) for name in POSE])
            place, turn = change(numbers[:3], Rotation.from_quat(numbers[3:]))
            row |= dict(zip(POSE, map(repr, [*place.tolist(), *turn.tolist()]), strict=True))
        return rows

    return rows_of(changed)


def poses_from(order: Callable[[int], list[int]]) -> Callable[[Path], None]:
    """Each row has the pose of another, and rows behind the last one go."""

    def changed(rows: Rows) -> Rows:
        poses = [{name: row[name] for name in POSE} for row in rows]
        source = order(len(rows))
        return [row | poses[at] for row, at in zip(rows, source, strict=False) if at >= 0]

    return rows_of(changed)


def exchanged(*views: int) -> Callable[[Path], None]:
    """Each of some rows has the pose of the one after it among them, and the last the first's."""
    after = dict(zip(views, [*views[1:], views[0]], strict=True))
    return poses_from(lambda count: [after.get(row, row) for row in range(count)])


def with_tool(folder: Path) -> None:
    """A tool is active in six rows, and another one is elsewhere."""
    each(
        lambda place, turn: (
            place + turn.apply([0.0, 0.01, 0.12]),
            (turn * Rotation.from_rotvec([0.0, 0.0, 0.3])).as_quat(),
        ),
        (2, 5, 6, 11, 14, 17),
    )(folder)
    each(lambda place, turn: (np.add(place, [0.02, 0.0, -0.03]), turn.as_quat()), (9,))(folder)


def moved_lens(document: dict) -> None:
    camera = document["camera"]
    camera["matrix"] = np.add(camera["matrix"], [6.0, 6.0, -5.0, 4.0]).tolist()


def without_distortion(document: dict) -> None:
    document["camera"] |= {"distortion": [0.0] * 5}


def held_without_distortion(document: dict) -> None:
    document["camera"] |= {"distortion": [0.0] * 5, "intrinsics": "hold"}


def turned_off(document: dict) -> None:
    document["mount"] = {"eye-in-hand": "eye-to-hand", "eye-to-hand": "eye-in-hand"}[
        document["mount"]
    ]


def pushed(cell: SimulatedCell) -> SimulatedCell:
    """The last twelve images are those of a camera that is elsewhere by 5 mm."""
    other = simulate(replace(cell.options, camera_moved_m=5e-3))
    return showing(other, [*cell.corners[:-12], *other.corners[-12:]])


@dataclass(frozen=True)
class Fault:
    """A fault of a sound cell, the kind that names it, and the command that is printed for it."""

    kind: str
    change: Callable[[Path], None] = lambda _: None
    seen: Callable[[SimulatedCell], SimulatedCell] = lambda cell: cell
    options: CellOptions = SOUND
    command: str = "--guess --yes"
    has_joints: bool = False  # Whether the arm has a model, and its rows have joint angles.


def read_late(by_m: float, by_rad: float, rows: Sequence[int] = ()) -> Callable[[Path], None]:
    """Poses of another instant, in some rows or all: off by so much, by their own digits."""

    def late(place: np.ndarray, turn: Rotation) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(np.abs(np.rint(1e9 * place)).astype(int))
        turned = Rotation.from_rotvec(by_rad * rng.normal(size=3))
        return place + by_m * rng.normal(size=3), (turn * turned).as_quat()

    return each(late, rows)


FAULTS = {
    "two rows exchanged": Fault("exchanged_views", exchanged(3, 11), command="--exchange 3,11"),
    "four rows exchanged in turn": Fault(
        "exchanged_views", exchanged(3, 6, 13, 10), command="--exchange 3,10,3,13,3,6"
    ),
    "rows two apart from one on": Fault(
        "shifted_rows",
        poses_from(lambda count: [at - 2 * (at > 9) for at in range(count)]),
        command="--shift",
    ),
    "all rows one apart": Fault("misread_poses", poses_from(lambda count: [*range(1, count), -1])),
    "millimetres": Fault("misread_poses", each(lambda place, turn: (1e3 * place, turn.as_quat()))),
    "quaternions that begin with w": Fault(
        "misread_poses", each(lambda place, turn: (place, np.roll(turn.as_quat(), 1)))
    ),
    "inverse poses": Fault(
        "misread_poses",
        each(lambda place, turn: (-turn.inv().apply(place), turn.inv().as_quat())),
    ),
    "another mount": Fault("misread_poses", document_of(turned_off)),
    "a board of another size": Fault(
        "board_size", options=replace(SOUND, board_scale=1.03), command="--board-scale"
    ),
    "a lens of another camera": Fault("lens", document_of(moved_lens), command="calibrate"),
    "a lens without its distortion": Fault(
        "lens", document_of(without_distortion), command="--intrinsics estimate"
    ),
    "a held lens without its distortion": Fault(
        "lens", document_of(held_without_distortion), command="--intrinsics estimate"
    ),
    "a camera that was pushed for the last views": Fault(
        "something_moved", seen=pushed, options=replace(SOUND, views=32), command="--views 20-31"
    ),
    "a tool that is active here and there": Fault(
        "something_moved", with_tool, command="--without-tool 2,5-6,11,14,17:"
    ),
    "poses of another instant than the joints": Fault(
        "late_poses", read_late(1e-3, 6e-4), command="--by-joints", has_joints=True
    ),
    # They disagree with the joint angles as those of another arm do.
    "poses read on the way": Fault(
        "late_poses", read_late(8e-3, 2e-2), command="--by-joints", has_joints=True
    ),
    "some poses read on the way": Fault(
        "late_poses",
        read_late(8e-3, 2e-2, rows=(3, 9, 10, 14)),
        command="--by-joints",
        has_joints=True,
    ),
    "poses read early on the way": Fault(
        "late_poses", read_late(2e-2, 7e-2), command="--by-joints", has_joints=True
    ),
}
QUICK = ("poses read on the way",)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name if name in QUICK else slow(name) for name in FAULTS])
def test_a_named_fault_is_mended_by_the_printed_command(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    fault = FAULTS[name]
    cell = fault.seen(simulate(fault.options))
    cell_session(cell, "cell", seen="corners").save(tmp_path / "cell")
    if not fault.has_joints:
        document_of(lambda it: it.pop("robot"))(tmp_path / "cell")
        joints = re.compile(r"q\d_rad").fullmatch
        rows_of(lambda rows: [{key: row[key] for key in row if not joints(key)} for row in rows])(
            tmp_path / "cell"
        )
    fault.change(tmp_path / "cell")
    try:
        kinds = [visioncal.calibrate("cell").verdict.causes[0].kind]
    except DegenerateError:
        # Misread poses may leave the motion open, and are named where it fails.
        kinds = ["misread_poses"]
    assert kinds == [fault.kind]
    followed = follow("calibrate", "cell", "-o", "out")
    assert fault.command in followed.runs[0].said
    assert followed.last.status == 0, followed.last.said
    words = [*followed.words]
    known = Calibration.load(words[words.index("-o") + 1])
    assert fault.kind not in [cause.kind for cause in known.verdict.causes]
    true, edge = cell.transforms["flange_from_cam"], known.edges["flange_from_cam"]
    away = edge.matrix[:3, :3].T @ (edge.matrix[:3, 3] - true[:3, 3])
    # Exceeded in one case of a thousand.
    assert away @ np.linalg.solve(edge.covariance[3:, 3:], away) < chi2.isf(1e-3, 3)


@pytest.mark.slow
def test_turns_that_are_wrong_each_in_its_way_are_no_other_frame(tmp_path):
    cell_session(simulate(SOUND), "cell", seen="corners").save(tmp_path / "cell")
    turns = iter(([3.0, 0.1, 0.0], [0.1, 3.0, 0.1], [2.2, 2.1, 0.0]))
    wrong = each(
        lambda place, turn: (place, (turn * Rotation.from_rotvec(next(turns))).as_quat()),
        (3, 9, 14),
    )
    wrong(tmp_path / "cell")
    joints = re.compile(r"q\d_rad").fullmatch
    rows_of(lambda rows: [{key: row[key] for key in row if not joints(key)} for row in rows])(
        tmp_path / "cell"
    )
    cause = visioncal.calibrate(tmp_path / "cell").verdict.causes[0]
    assert (cause.kind, cause.views) == ("wrong_views", (3, 9, 14))


@pytest.mark.parametrize("lens", ["auto", slow("hold")])
@pytest.mark.parametrize("begins", [(320.0, 180.0), slow((60.0, 40.0))])
def test_a_lens_of_the_whole_sensor_is_named_by_where_a_part_of_it_begins(tmp_path, lens, begins):
    cell_session(simulate(SOUND), "cell", seen="corners").save(tmp_path / "cell")

    def whole(document):
        document["camera"] |= {"intrinsics": lens}
        focal, centre = np.split(np.array(document["camera"]["matrix"]), 2)
        document["camera"]["matrix"] = [*focal.tolist(), *(centre + begins).tolist()]

    document_of(whole)(tmp_path / "cell")
    cause = visioncal.calibrate(tmp_path / "cell").verdict.causes[0]
    assert cause.kind in ("other_lens", "lens")
    found = re.search(r"begins (\d+) px to the right and (\d+) px below", cause.words)
    # A few pixels of the centre trade with the distortion.
    assert [int(at) for at in found.groups()] == pytest.approx(begins, abs=5.0)
    assert "times as large" not in cause.words


@pytest.mark.parametrize("lens", ["auto", slow("hold")])
def test_a_matrix_in_the_order_of_its_rows_is_named(tmp_path, lens):
    cell_session(simulate(SOUND), "cell", seen="corners").save(tmp_path / "cell")
    right = []

    def by_rows(document):
        fx, fy, cx, cy = right[:] = document["camera"]["matrix"]
        document["camera"] |= {"intrinsics": lens, "matrix": [fx, cx, fy, cy]}

    document_of(by_rows)(tmp_path / "cell")
    cause = visioncal.calibrate(tmp_path / "cell").verdict.causes[0]
    assert cause.kind in ("other_lens", "lens")
    found = re.search(r"in the order fx, cx, fy, cy: write matrix = \[(.*?)\]", cause.words)
    assert [float(at) for at in found[1].split(", ")] == pytest.approx(right, rel=1e-5)


def test_another_distortion_is_no_picture_of_another_size(tmp_path):
    cell_session(simulate(SOUND), "cell", seen="corners").save(tmp_path / "cell")
    k1, k2, *_ = SOUND.camera.distortion
    other = {"distortion": [k1, k2, -0.05, 0.08, 0.06]}
    document_of(lambda it: it["camera"].update(other))(tmp_path / "cell")
    cause = visioncal.calibrate(tmp_path / "cell").verdict.causes[0]
    assert cause.kind == "other_lens"
    assert "The matrix is about as stated: the distortion is another one" in cause.words
    assert "times as large" not in cause.words
