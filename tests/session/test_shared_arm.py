"""Several sessions of one arm: one calibration of the arm, frames of each session its own."""

from dataclasses import replace

import numpy as np
import pytest
from support.commands import visioncal
from support.wrong_arms import target_in_camera

from visioncal.calibration.run import calibrate
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.estimation.workspace import postures
from visioncal.session import Session
from visioncal.session.columns import MEASURED_CAM_POSE
from visioncal.session.shared_arm import join_sessions
from visioncal.simulation import CellOptions, simulate, write_session

# Zeros of the joints are off by some milliradians, which each recording tells from few stops.
CELL = CellOptions(views=12, seed=5, offset_sigma_rad=2e-3, pixel_sigma_px=0.2)


def session_of(cell, name, **changed) -> Session:
    """The session of a simulated cell, with its corners."""
    options = cell.options
    return Session.from_corners(
        [(corner.ids, corner.px) for corner in cell.corners],
        cell.robot.base_from_flange,
        options.target,
        cell.stated[""].resolution,
        **{
            "mount": options.mount,
            "camera": cell.stated[""],
            "robot": options.robot,
            "q": cell.robot.joints,
            "name": name,
            **changed,
        },
    )


@pytest.fixture(scope="module")
def cells():
    mounts = ("eye-in-hand", "eye-in-hand", "eye-to-hand")
    return [simulate(replace(CELL, recording=at, mount=mount)) for at, mount in enumerate(mounts)]


@pytest.fixture(scope="module")
def sessions(cells):
    return [session_of(cell, f"week {at}") for at, cell in enumerate(cells)]


def error_mm(cell, calibration) -> float:
    """How far the camera's place seen from the board is off, all over the workspace [mm, rms]."""
    q = postures(calibration.calibrated_robot)
    true = target_in_camera("eye-in-hand", *cell.transforms.values(), cell.robot.flange_at(q))
    edges = [transform.as_matrix() for transform in calibration.transforms.values()]
    ours = target_in_camera("eye-in-hand", *edges, calibration.base_from_flange(q).as_matrix())
    away = (invert(true) - invert(ours))[:, :3, 3]
    return 1e3 * float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


def test_an_arm_is_known_better_from_several_sessions_than_from_one(cells, sessions):
    alone = calibrate(sessions[0], level="offsets")
    joined = calibrate(join_sessions(sessions), level="offsets")
    parts = [joined.of(camera=name, target=name) for name in ("s1", "s2")]
    sigma, before = (calibration.arm.workspace_sigma_mm.median for calibration in (parts[0], alone))
    # Three times the stops: 0.6 of the sigma, less what the session's own frames leave.
    assert sigma < 0.85 * before
    for cell, found in zip(cells, parts, strict=False):
        # The p95 over places; one draw of all errors is beyond twice it once in a thousand.
        assert error_mm(cell, found) < 2.0 * found.arm.workspace_sigma_mm.p95
    # The camera of the second session, on the same mount, is estimated apart and agrees.
    hands = [part.transforms["flange_from_cam"] for part in parts]
    apart_mm = 1e3 * np.linalg.norm((hands[0].inv() * hands[1]).translation)
    assert apart_mm < 3.5 * np.hypot(*(part.edges["flange_from_cam"].sigma_mm for part in parts))


def timed(session: Session, from_s: float) -> Session:
    """The same with a time of each view."""
    cells = [
        [*map(view.cell, session.columns), repr(from_s + view.number)] for view in session.views
    ]
    return Session.assemble(
        session.document,
        [*session.columns, "stamp_s"],
        cells,
        session.images,
        target_document=session.target_document,
        corners=session.corner_table,
    )


def test_views_frames_and_times_of_each_session_stay_apart(sessions):
    joined = join_sessions([timed(session, 10.0) for session in sessions])
    assert [view.number for view in joined.views] == list(range(36))
    assert {view.text["camera"] for view in joined.views[12:24]} == {"s2"}
    assert joined.frames["cam_s2"] == "flange"
    assert joined.frames["cam_s3"] == "base"
    assert len(joined.corner_table) == sum(len(session.corner_table) for session in sessions)
    stamps = [view.stamp_s for view in joined.views]
    assert stamps[:2] == [10.0, 11.0]
    assert stamps[12] > stamps[11]
    assert stamps == sorted(stamps)
    assert join_sessions(sessions[:1]) is sessions[0]


def test_images_are_read_from_their_own_session(tmp_path):
    for name in ("first", "second"):
        cell = simulate(CellOptions(views=3, seed=len(name)))
        write_session(cell, tmp_path / name)
    sessions = [Session.load(tmp_path / name) for name in ("first", "second")]
    joined = join_sessions(sessions)
    for own, view in zip([*sessions[0].views, *sessions[1].views], joined.views, strict=True):
        store = sessions[0 if view.image.startswith("s1/") else 1].images
        assert joined.images.read(view.image) == store.read(own.image)
    assert joined.images.absence("s2/images/none.png")


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"robot": "ur5e"}, "the robots of 'week 0' and 'other' differ"),
        ({"robot": None}, "'other' names no known robot"),
        ({"frames": {"cam": "flange", "target": "base"}}, "one camera and one board each"),
    ],
)
def test_what_cannot_be_joined_is_refused_by_name(sessions, changed, words):
    document = {**sessions[1].document, "name": "other"}
    for key, value in changed.items():
        document = {
            value: known for value, known in document.items() if value != key and value not in key
        }
        document |= {} if value is None else {key: {"model": value} if key == "robot" else value}
    other = Session.assemble(
        document,
        sessions[1].columns,
        [[*map(view.cell, sessions[1].columns)] for view in sessions[1].views],
        sessions[1].images,
        target_document=sessions[1].target_document,
        corners=sessions[1].corner_table,
    )
    with pytest.raises(DataError, match=words):
        join_sessions([sessions[0], other])
    with pytest.raises(DataError, match="is there twice"):
        join_sessions([sessions[0], sessions[0]])
    known = {key: at for key, at in sessions[1].document.items() if key not in ("camera", "target")}
    columns = [*sessions[1].columns, *MEASURED_CAM_POSE]
    rows = [[*map(view.cell, sessions[1].columns), *"0001000"] for view in sessions[1].views]
    poses = Session.assemble(known, columns, rows, sessions[1].images)
    with pytest.raises(DataError, match="has no board"):
        join_sessions([sessions[0], poses])


def test_the_command_joins_only_where_it_is_asked_to(sessions, tmp_path):
    folders = [tmp_path / f"week_{at}" for at in range(2)]
    for folder, session in zip(folders, sessions, strict=False):
        session.save(folder)
    refused = visioncal("calibrate", *folders, "-o", tmp_path / "out")
    assert refused.status == 2
    assert "--robot-shared one arm from all" in refused.err
    done = visioncal(
        "calibrate",
        *folders,
        "-o",
        tmp_path / "out",
        "--robot-shared",
        "--no-report",
        "--level",
        "offsets",
    )
    assert done.status == 0, done.err
    assert "flange_from_cam_s2" in done.out
