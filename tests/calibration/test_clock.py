"""The offset between the clocks of camera and robot: told by motion, stated, or of no matter."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import calibrated_sweep
from support.marks import slow

from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES, calibrate
from visioncal.calibration.stages.clock_offset import LARGEST_SIGMA_S, ClockedViews
from visioncal.calibration.stages.clocks import set_clocks
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.pnp import stated_poses
from visioncal.calibration.verification import verify
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import exp, invert, log
from visioncal.present.recording import write_recording
from visioncal.present.report.content import method_facts
from visioncal.results import Calibration
from visioncal.results.sections import ClockResult
from visioncal.robot import load_robot
from visioncal.session import MemoryImages, Session, Stream, View
from visioncal.session.columns import MEASURED_CAM_POSE, POSE
from visioncal.simulation import (
    CellOptions,
    SimulatedCell,
    SweepOptions,
    cell_session,
    forward,
    measured_poses,
    simulate,
    sweep,
)

AHEAD_S = 0.0372
# 7 s at 30 Hz; a PnP's noise of some tenths of a millimetre.
SHORT = SweepOptions(stops=5, camera_minus_robot_s=AHEAD_S)


def clocked_of(session):
    """What its stream gives the views of a session of measured poses."""
    (clocked,) = set_clocks(Observed(session, poses=stated_poses(session))).clocks.values()
    return clocked


def swept(seed=0, mount="eye-in-hand", how=SHORT, **options) -> SimulatedCell:
    return sweep(CellOptions(seed=seed, mount=mount, pixel_sigma_px=0.1, **options), how)


@pytest.fixture(scope="module")
def moved() -> SimulatedCell:
    return swept()


@pytest.fixture(scope="module")
def session(moved) -> Session:
    return cell_session(moved, "swept", seen="poses")


@pytest.fixture(scope="module")
def known(session) -> Calibration:
    return calibrate(session)


@pytest.fixture(scope="module")
def long() -> SimulatedCell:
    """Of 20 s, long enough to tell how a clock runs."""
    return swept(how=SweepOptions())


def restamped(session: Session, stamp) -> Session:
    """The session with the views' times as `stamp` makes them of (n,) times [s]."""
    before_s = np.array([view.stamp_s for view in session.views])
    pairs = zip(session.views, stamp(before_s).tolist(), strict=True)
    views = tuple(replace(view, numbers={**view.numbers, "stamp_s": s}) for view, s in pairs)
    return replace(session, views=views)


@pytest.mark.parametrize(
    ("stamp", "words"),
    [
        (lambda s: s - 0.02 * (s >= s[200]), "from view 200 on it is -"),
        slow(lambda s: s + 1e-3 * (s - s[0]), "drifts against the robot's, by +"),
    ],
    ids=["back", "drift"],
)
def test_a_clock_that_changes_is_named_and_taken_out(long, stamp, words):
    found = calibrate(restamped(cell_session(long, "swept", seen="poses"), stamp))
    cause = found.verdict.causes[0]
    assert cause.kind == "clock_changed"
    assert words in cause.words
    away, _ = x_error(long, found)
    # Some frames about the jump are stamped in a mixed order; the rest is as without it.
    assert np.linalg.norm(away[3:]) < 3e-4


@pytest.mark.parametrize(("mount", "seeds"), [("eye-in-hand", 1), slow("eye-to-hand", 3)])
def test_a_clock_that_runs_evenly_is_not_doubted_for_an_arm_that_errs(mount, seeds):
    for seed in range(seeds):
        moved = swept(seed, mount, SweepOptions(), dh_sigma_m=5e-4, dh_sigma_rad=5e-4)
        assert not clocked_of(cell_session(moved, "swept", seen="poses")).warnings


def stating(session: Session, ahead_s: float) -> Session:
    document = {**session.document, "clock": {"camera_minus_robot_s": ahead_s}}
    return replace(session, document=document)


def cut(session: Session, keep) -> Session:
    """Leaves out samples of the robot's stream by their times."""
    robot = session.streams["robot"]
    values = robot.values[keep(robot.stamps_s)]
    return session.with_streams({"robot": replace(robot, values=values)})


def x_error(cell, result) -> tuple[np.ndarray, np.ndarray]:
    """The error of the camera's edge, (6,), and its covariance."""
    name = next(iter(cell.transforms))
    edge = result.edges[name]
    return log(invert(cell.transforms[name]) @ edge.matrix), edge.covariance


@pytest.mark.parametrize(
    ("seed", "mount", "ahead_s"),
    [(2, "eye-to-hand", -0.61), slow(3, "eye-in-hand", 0.0)],
)
def test_the_offset_is_told_by_a_sweep(seed, mount, ahead_s):
    cell = swept(seed, mount, replace(SHORT, camera_minus_robot_s=ahead_s))
    result = calibrate(cell_session(cell, "swept", seen="poses"))
    clock = result.clock
    error_s = clock.camera_minus_robot_s - ahead_s
    assert clock.method == "motion"
    # A hundredth of what is asked for (2 ms), as told by some 200 frames; no error is beyond four
    # of its sigmas, and none of these is so small that this were easy.
    assert abs(error_s) < 2e-4
    assert abs(error_s) < 4 * clock.sigma_s
    assert clock.sigma_s < 1e-4
    error, covariance = x_error(cell, result)
    # Six degrees of freedom: one in ten thousand is beyond.
    assert error @ np.linalg.solve(covariance, error) < 27.9


@pytest.mark.slow
def test_another_sweep_verifies_the_camera(known):
    again = swept(recording=1)
    held = verify(cell_session(again, "again", seen="poses"), known)
    assert held.passed
    assert held.predicted.stops > 20
    knocked = cell_session(swept(recording=1, camera_moved_m=2e-3), "knocked", seen="poses")
    assert verify(knocked, known).named[0].name == "camera"


def test_images_are_placed_in_time_by_their_corners(moved):
    result = result_of(calibrated_sweep(moved))
    assert abs(result.clock.camera_minus_robot_s - AHEAD_S) < 1e-4
    assert result.noise["pixel_px"] == pytest.approx(0.1, rel=0.05)
    error, covariance = x_error(moved, result)
    assert error @ np.linalg.solve(covariance, error) < 27.9


def test_joints_are_placed_in_time_too(moved, session):
    columns = ("stamp_s", *(f"q{at}_rad" for at in range(1, 7)))
    values = np.stack([moved.streams["robot"][name] for name in columns], axis=1)
    robot = load_robot("ur10e").document
    joints = replace(session, robot_document=robot).with_streams({"arm": Stream(columns, values)})
    result = calibrate(joints, level="offsets")
    assert abs(result.clock.camera_minus_robot_s - AHEAD_S) < 1e-4
    assert result.arm.level in ("nominal", "offsets")
    assert "streams/arm.csv" in " ".join(result.verdict.reasons)


def test_its_recording_gives_the_same(session, known, tmp_path):
    write_recording(tmp_path / "session.rrd", session, None, (), None)
    one, other = known, calibrate(tmp_path / "session.rrd")
    assert one.session_sha256 == other.session_sha256
    assert one.clock == other.clock
    for name, edge in one.edges.items():
        np.testing.assert_array_equal(edge.matrix, other.edges[name].matrix)
    (fact,) = [fact for fact in method_facts(one) if fact.label == "camera's clock"]
    assert fact.value.startswith("37.2")
    assert fact.note.endswith("by motion")


def test_a_stated_offset_is_compared(session):
    # A millisecond is a thirtieth of a frame: nobody stamps better.
    right = clocked_of(stating(session, AHEAD_S + 1e-3))
    assert not any("is stated as" in warning.words for warning in right.warnings)
    wrong = calibrate(stating(session, 0.0))
    told = "camera_minus_robot_s is stated as +0.00 ms, but the motion gives +37.2"
    assert any(told in reason for reason in wrong.verdict.reasons)
    assert wrong.verdict.status == "check"
    assert wrong.clock.stated_s == 0.0
    assert abs(wrong.clock.camera_minus_robot_s - AHEAD_S) < 1e-4


def test_what_the_stream_does_not_cover_is_left_out_by_name(session):
    gapped = cut(session, lambda value: ((value < 3.0) | (value > 3.4)) & (value < 6.3))
    result = calibrate(gapped)
    reasons = [view.reason for view in result.views]
    assert abs(result.clock.camera_minus_robot_s - AHEAD_S) < 1e-4
    # 12 frames in the gap of 0.4 s, and some after the end.
    assert sum("its stream has no samples" in reason for reason in reasons) > 20
    assert any("samples are missing in 1 place" in reason for reason in result.verdict.reasons)


def dwelling(ahead_s: float, at_rest: int = 20) -> Session:
    """A cell's stops, each held for 1.2 s: views in the middle of rests, the last ones in moves."""
    cell = simulate(CellOptions(seed=4, pixel_sigma_px=0.1))
    times_s = np.arange(0.0, 2.2 * len(cell.robot.joints) - 1.0, 0.008)
    stop, phase_s = np.divmod(times_s, 2.2)
    share = np.clip(phase_s - 1.2, 0.0, 1.0)
    share = share**3 * (10 - 15 * share + 6 * share**2)
    here = stop.astype(int)
    there = np.minimum(here + 1, len(cell.robot.joints) - 1)
    joints = cell.robot.joints[here] + share[:, None] * (
        cell.robot.joints[there] - cell.robot.joints[here]
    )
    poses = quaternions(forward(cell.robot.arm, joints))
    views = [
        View(at, numbers=dict(zip(MEASURED_CAM_POSE, row, strict=True)) | {
            "stamp_s": 2.2 * at + (0.6 if at < at_rest else 1.3) + ahead_s
        })
        for at, row in enumerate(quaternions(measured_poses(cell)).tolist())
    ]  # fmt: skip
    document = {"schema": 1, "name": "stops", "mount": "eye-in-hand"}
    columns = ("view", "stamp_s", *MEASURED_CAM_POSE)
    resting = Session(document, columns, tuple(views), None, None, MemoryImages({}))
    stamped = np.hstack([times_s[:, None], poses])
    return resting.with_streams({"robot": Stream(("stamp_s", *POSE), stamped)})


def quaternions(poses: np.ndarray) -> np.ndarray:
    """(n, 7) positions and quaternions."""
    rotations = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return np.hstack([poses[:, :3, 3], rotations])


def test_at_rest_the_clocks_do_not_matter():
    result = calibrate(dwelling(0.2))
    assert result.clock.method == "rest"
    assert result.clock.sigma_s is None
    assert any(
        "taken at rest, where this does not count" in reason for reason in result.verdict.reasons
    )
    assert result.verdict.status == "good"
    assert sum(view.used for view in result.views) == 20


def test_views_in_motion_are_left_out_where_nothing_tells_the_offset():
    session = dwelling(0.0, at_rest=14)
    # Views that no fit may use tell nothing of the clocks either.
    held = [replace(view, holdout=view.number >= 14) for view in session.views]
    clocked = clocked_of(replace(session, views=tuple(held)))
    assert sorted(rejection.view for rejection in clocked.rejections) == list(range(14, 20))
    assert all("taken in motion" in rejection.reason for rejection in clocked.rejections)
    assert [view.number for view in clocked.views] == list(range(14))
    assert "6 views that were taken in motion are left out" in clocked.warnings[0].words


def screwed(noise: float = 1e-4) -> Session:
    """A flange that turns evenly about one axis, which no offset changes."""
    rng, times_s = np.random.default_rng(5), np.arange(0, 20, 0.02)
    frames_s = np.arange(1, 19, 1 / 30)
    way = np.array([0.05, 0.1, 0.2, 0.01, 0.02, 0.005])
    x, z = exp(rng.normal(size=(2, 6)))
    seen = invert(exp(np.outer(frames_s, way)) @ x) @ z @ exp(noise * rng.normal(size=(540, 6)))
    return streamed("screw", (frames_s, seen), (times_s, exp(np.outer(times_s, way))))


def streamed(name: str, camera, robot) -> Session:
    """A session of what a camera saw, and a stream of the robot: times and poses of either."""
    rows = quaternions(camera[1]).tolist()
    views = [
        View(at, numbers={"stamp_s": float(value)} | dict(zip(MEASURED_CAM_POSE, row, strict=True)))
        for at, (value, row) in enumerate(zip(camera[0], rows, strict=True))
    ]
    document = {"schema": 1, "name": name, "mount": "eye-in-hand"}
    columns = ("view", "stamp_s", *MEASURED_CAM_POSE)
    session = Session(document, columns, tuple(views), None, None, MemoryImages({}))
    stamped = np.hstack([robot[0][:, None], quaternions(robot[1])])
    return session.with_streams({"robot": Stream(("stamp_s", *POSE), stamped)})


def test_motion_that_does_not_tell_the_offset_is_refused():
    with pytest.raises(DegenerateError, match=r"is left open by 540 views, of which 0 .* at rest"):
        calibrate(screwed())


def periodic() -> Session:
    """A flange that does the same every two seconds."""
    rng, times_s = np.random.default_rng(7), np.arange(0, 20, 0.02)
    frames_s = np.arange(3, 17, 1 / 15)
    turns = np.pi * np.array([1, 2, 1, 2, 1, 2])
    sizes = np.array([0.4, 0.5, 0.3, 0.1, 0.1, 0.1])
    way = [
        exp(np.sin(np.outer(array, turns) + np.arange(6)) * sizes) for array in (times_s, frames_s)
    ]
    x, z = exp(rng.normal(size=(2, 6)))
    seen = invert(way[1] @ x) @ z @ exp(1e-4 * rng.normal(size=(len(frames_s), 6)))
    return streamed("periodic", (frames_s, seen), (times_s, way[0]))


@pytest.mark.slow
def test_motion_that_repeats_itself_is_told_by_what_is_stated():
    with pytest.raises(DegenerateError, match=r"the motion repeats itself: offsets of .* ms"):
        calibrate(periodic())
    again = stating(periodic(), 2.05)
    clock = clocked_of(again).clock
    # A period off, which is for whoever stated it to know.
    assert abs(clock.camera_minus_robot_s - 2.0) < 1e-3


@pytest.mark.parametrize("per_s", [1e3, 1e6])
def test_times_of_views_and_robot_in_another_unit_are_refused(session, per_s):
    stream = session.streams["robot"]
    scaled = stream.values * np.where(np.array(stream.columns) == "stamp_s", per_s, 1.0)
    rows = [{**view.numbers, "stamp_s": per_s * view.stamp_s} for view in session.views]
    views = tuple(replace(view, numbers=row) for view, row in zip(session.views, rows, strict=True))
    both = replace(session, views=views).with_streams({"robot": Stream(stream.columns, scaled)})
    with pytest.raises(DataError, match=r"streams/robot\.csv: .* stamp_s is in seconds"):
        calibrate(both)


def test_times_that_are_missing_are_asked_for_where_a_stream_waits_for_them(session):
    rows = [{k: v for k, v in view.numbers.items() if k != "stamp_s"} for view in session.views]
    views = tuple(replace(view, numbers=row) for view, row in zip(session.views, rows, strict=True))
    with pytest.raises(DataError, match="where a stream has the poses, stamp_s"):
        calibrate(replace(session, views=views))


def test_a_clock_that_was_set_during_the_recording_costs_no_memory(session):
    """The first samples and frames are of 1970, as of devices that have no clock of their own."""
    stream, early = session.streams["robot"], 0.5
    stamps = stream.stamps_s
    later = np.where(np.array(stream.columns) == "stamp_s", 1.76e9, 0.0) * (stamps > early)[:, None]
    rows = [
        {**view.numbers, "stamp_s": view.stamp_s + 1.76e9 * (view.stamp_s > early + AHEAD_S)}
        for view in session.views
    ]
    views = tuple(replace(view, numbers=row) for view, row in zip(session.views, rows, strict=True))
    moved = replace(session, views=views)
    found = clocked_of(moved.with_streams({"robot": Stream(stream.columns, stream.values + later)}))
    assert abs(found.clock.camera_minus_robot_s - AHEAD_S) < 1e-4


def test_times_that_images_share_are_refused(session):
    for stamp in (lambda s: np.full_like(s, 3.0), np.floor):
        with pytest.raises(DegenerateError, match="is left open") as caught:
            clocked_of(restamped(session, stamp))
        assert "views.csv: stamp_s" in caught.value.culprits
    # Whatever is stated, one time is no time of all of them.
    with pytest.raises(DataError, match="no view has a pose of the robot"):
        calibrate(stating(restamped(session, np.zeros_like), AHEAD_S))


def test_at_rest_images_may_share_a_time():
    resting = dwelling(0.0)
    again = [replace(view, number=view.number + 100) for view in resting.views]
    assert clocked_of(replace(resting, views=(*resting.views, *again))).clock.method == "rest"


def test_times_that_are_not_those_of_the_images_are_refused(session):
    shuffled = np.random.default_rng(3).permutation
    with pytest.raises(DegenerateError, match="not of the same motion") as caught:
        clocked_of(restamped(session, shuffled))
    assert "views.csv: stamp_s" in caught.value.culprits
    # Rows in any order are as good, where each has the time of its own image.
    numbers = shuffled(len(session.views)).tolist()
    views = [replace(view, number=at) for view, at in zip(session.views, numbers, strict=True)]
    clock = clocked_of(replace(session, views=tuple(views))).clock
    assert abs(clock.camera_minus_robot_s - AHEAD_S) < 1e-4


def test_a_stream_of_another_time_is_named(session):
    late = session.streams["robot"].values + 1e6 * np.eye(14)[0]
    late = replace(session.streams["robot"], values=late)
    with pytest.raises(DataError, match=r"No view lies within streams/robot.csv"):
        calibrate(session.with_streams({"robot": late}))
    # Whoever states about how far they are apart is told the rest.
    stated = stating(session.with_streams({"robot": late}), 1.0 - 1e6)
    clocked = clocked_of(stated)
    # Stamps of a million seconds have digits of a tenth of a nanosecond.
    assert abs(clocked.clock.camera_minus_robot_s + 1e6 - AHEAD_S) < 1e-4


def test_a_stated_offset_stands_where_motion_does_not_tell_it():
    even = stating(screwed(), 0.02)
    clocked = clocked_of(even)
    assert (clocked.clock.method, clocked.clock.sigma_s) == ("stated", 1e-3)
    assert "is taken as stated, +20 ms, to 1 ms" in clocked.warnings[0].words
    view = clocked.views[0]
    way = np.array([0.05, 0.1, 0.2, 0.01, 0.02, 0.005])
    there = exp((view.stamp_s - 0.02) * way)
    np.testing.assert_allclose(view.base_from_flange().as_matrix(), there, atol=1e-9)
    np.testing.assert_allclose(clocked.speeds[view.number], way, atol=1e-7)


def test_what_is_open_about_the_clocks_counts(session):
    known = RunState(session)
    for stage in STAGES[: [stage.name for stage in STAGES].index("clock") + 1]:
        known = stage.run(known)
    spreads = []
    for sigma_s in (1e-6, 5e-3):
        clock = replace(next(iter(known.clocks.values())).clock, sigma_s=sigma_s)
        clocks = {pair: replace(clocked, clock=clock) for pair, clocked in known.clocks.items()}
        later = replace(known, clocks=clocks)
        for stage in STAGES[[stage.name for stage in STAGES].index("clock") + 1 :]:
            later = stage.run(later)
        budget = result_of(later).uncertainty.budget_mm
        spreads.append((budget["clock"], budget["total"]))
    assert spreads[0][0] < 1e-3
    # The used views themselves tell the offset to better than 5 ms, but not for nothing.
    assert spreads[1][1] > spreads[0][1]
    assert spreads[1][0] > spreads[0][0]


def test_frames_that_are_in_the_fit_tell_the_offset_once():
    clock = ClockResult(camera_minus_robot_s=0.02, method="motion", sigma_s=1e-4, frames=100)
    clocked = ClockedViews(clock, (), dict.fromkeys(range(75), np.ones(6)), (), {}, (), ())
    # A quarter of the frames tells half as well.
    assert clocked.prior_sigma_s() == pytest.approx(2e-4)
    few = replace(clocked, clock=replace(clock, frames=75))
    assert few.prior_sigma_s() == LARGEST_SIGMA_S
    # The arm as stated was told by, and its errors are sought.
    assert clocked.prior_sigma_s(erring=True) == LARGEST_SIGMA_S
    stated = replace(clocked, clock=replace(clock, method="stated", frames=None))
    assert stated.prior_sigma_s(erring=True) == 1e-4


def test_views_with_poses_of_their_own_ask_no_stream(moved, session):
    rows = quaternions(moved.robot.base_from_flange).tolist()
    posed = tuple(
        replace(view, numbers={**view.numbers, **dict(zip(POSE, row, strict=True))})
        for view, row in zip(session.views, rows, strict=True)
    )
    result = calibrate(replace(session, views=posed[::8]))
    assert result.clock is None
    assert all(view.used for view in result.views)
