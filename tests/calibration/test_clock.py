"""The clocks of camera and robot, and rolling shutters: told by motion, stated, or of no matter."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import calibrated_sweep
from support.marks import slow
from support.misfits import misfit
from support.refusals import raised

from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES, calibrate
from visioncal.calibration.stages.cameras import stated_poses
from visioncal.calibration.stages.clock_offset import why_undetermined
from visioncal.calibration.stages.clocks import set_clocks
from visioncal.calibration.stages.observed import Observed
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import MOUNTS
from visioncal.estimation.clock_correlation import Match
from visioncal.estimation.effects.rolling_shutter import delayed_points, target_twists
from visioncal.present.recording import write_recording
from visioncal.present.report.content import method_facts
from visioncal.robot import load_robot
from visioncal.session import MemoryImages, Session, Stream, View
from visioncal.session.columns import MEASURED_CAM_POSE, POSE, pose_row
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
from visioncal.vision.corners import CornerStack
from visioncal.vision.targets import numbered_positions

AHEAD_S = 0.0372
# 7 s at 30 Hz; a PnP's noise of some tenths of a millimetre.
SHORT = SweepOptions(stops=5, camera_minus_robot_s=AHEAD_S)
READOUT_S = 0.0124
# 12 s at 30 Hz, at up to 0.2 m/s and 0.5 rad/s.
HURRIED = SweepOptions(stops=8, camera_minus_robot_s=0.037, readout_s=READOUT_S)
# At up to 0.5 m/s and 1.2 rad/s.
FAST = replace(HURRIED, stops=14, pace_s=0.7, frames_hz=15.0)


def clocked_of(session):
    """What its stream gives the views of a session of measured poses."""
    (clocked,) = set_clocks(Observed(session, poses=stated_poses(session))).clocks.values()
    return clocked


@pytest.mark.slow
def test_a_clock_that_runs_evenly_is_not_doubted_for_an_arm_that_errs():
    moved = swept(how=SweepOptions(), dh_sigma_m=5e-4, dh_sigma_rad=5e-4)
    assert not clocked_of(cell_session(moved, "swept", seen="poses")).warnings


def with_stream(session: Session, change) -> Session:
    """The session with other values in the robot's stream."""
    robot = session.streams["robot"]
    return session.with_streams({"robot": replace(robot, values=change(robot))})


def stating(session: Session, ahead_s: float) -> Session:
    document = {**session.document, "clock": {"camera_minus_robot_s": ahead_s}}
    return replace(session, document=document)


@pytest.mark.slow
def test_joints_are_placed_in_time_too(session):
    columns = ("stamp_s", *(f"q{at}_rad" for at in range(1, 7)))
    robot = swept().streams["robot"]
    values = np.stack([robot[name] for name in columns], axis=1)
    robot = load_robot("ur10e").document
    joints = replace(session, robot_document=robot).with_streams({"arm": Stream(columns, values)})
    result = calibrate(joints, level="offsets")
    assert abs(result.clock.camera_minus_robot_s - AHEAD_S) < 1e-4
    assert result.arm.level in ("nominal", "offsets")
    assert "streams/arm.csv" in " ".join(result.verdict.reasons)


@pytest.mark.slow
def test_a_recording_gives_the_same_clock_as_its_session(session, tmp_path):
    write_recording(tmp_path / "session.rrd", session, None, (), None)
    one, other = calibrate(session), calibrate(tmp_path / "session.rrd")
    assert one.session_sha256 == other.session_sha256
    assert one.clock == other.clock
    for name, edge in one.edges.items():
        np.testing.assert_array_equal(edge.matrix, other.edges[name].matrix)
    (fact,) = [fact for fact in method_facts(one) if fact.label == "camera's clock"]
    assert fact.value.startswith("37.2")
    assert fact.note.endswith("by motion")


@pytest.mark.slow
def test_a_stated_offset_is_compared(session):
    # A millisecond is a thirtieth of a frame: nobody stamps better.
    right = clocked_of(stating(session, AHEAD_S + 1e-3))
    assert not any("is stated as" in warning.words for warning in right.warnings)
    wrong = calibrate(stating(session, 0.0))
    words = "camera_minus_robot_s is stated as +0.00 ms, but the motion gives +37.2"
    assert any(words in reason for reason in wrong.verdict.reasons)
    assert wrong.verdict.status == "check"
    assert wrong.clock.stated_s == 0.0
    assert abs(wrong.clock.camera_minus_robot_s - AHEAD_S) < 1e-4


@pytest.mark.slow
def test_views_that_the_stream_does_not_cover_are_left_out_by_name(session):
    def gapped(robot):
        s = robot.stamps_s
        return robot.values[((s < 3.0) | (s > 3.4)) & (s < 6.3)]

    result = calibrate(with_stream(session, gapped))
    reasons = [view.reason for view in result.views]
    assert abs(result.clock.camera_minus_robot_s - AHEAD_S) < 1e-4
    # 12 frames in the gap of 0.4 s, and some after the end.
    assert sum("its stream has no samples" in reason for reason in reasons) > 20
    assert any("samples are missing in 1 place" in reason for reason in result.verdict.reasons)


def dwelling(ahead_s: float, at_rest: int = 20) -> Session:
    """A cell's stops, each held for 1.2 s: views in the middle of rests, the last ones in moves."""
    cell = simulate(CellOptions(seed=4, pixel_sigma_px=0.1))
    q, stops = cell.robot.joints, np.arange(len(cell.robot.joints))
    times_s = np.arange(0.0, 2.2 * len(q) - 1.0, 0.008)
    stop, phase_s = np.divmod(times_s, 2.2)
    share = np.clip(phase_s - 1.2, 0.0, 1.0)
    share = (share**3 * (10 - 15 * share + 6 * share**2))[:, None]
    index = stop.astype(int)
    joints = q[index] + share * (q[np.minimum(index + 1, len(q) - 1)] - q[index])
    stamps = 2.2 * stops + np.where(stops < at_rest, 0.6, 1.3) + ahead_s
    return streamed((stamps, measured_poses(cell)), (times_s, forward(cell.robot.arm, joints)))


def test_views_in_motion_are_left_out_where_nothing_determines_the_offset():
    session = dwelling(0.0, at_rest=14)
    # Views that no fit may use tell nothing of the clocks either.
    held = [replace(view, holdout=view.number >= 14) for view in session.views]
    clocked = clocked_of(replace(session, views=tuple(held)))
    assert sorted(rejection.view for rejection in clocked.rejections) == list(range(14, 20))
    assert all("taken in motion" in rejection.reason for rejection in clocked.rejections)
    assert [view.number for view in clocked.views] == list(range(14))
    assert "6 views that were taken in motion are left out" in clocked.warnings[0].words


def streamed(camera, robot) -> Session:
    """A session of what a camera saw, and a stream of the robot: times and poses of either."""
    views = []
    for at, (stamp_s, pose) in enumerate(zip(*camera, strict=True)):
        seen = {f"cft_{name}": value for name, value in pose_row(pose).items()}
        views.append(View(at, numbers={"stamp_s": float(stamp_s)} | seen))
    document = {"schema": 1, "name": "streamed", "mount": "eye-in-hand"}
    columns = ("view", "stamp_s", *MEASURED_CAM_POSE)
    session = Session(document, columns, tuple(views), None, None, MemoryImages({}))
    rows = [[stamp_s, *pose_row(pose).values()] for stamp_s, pose in zip(*robot, strict=True)]
    return session.with_streams({"robot": Stream(("stamp_s", *POSE), np.array(rows))})


def test_times_that_are_not_those_of_the_images_are_refused(session):
    shuffled = np.random.default_rng(3).permutation
    for stamp, words in (
        (lambda s: np.full_like(s, 3.0), "is left open"),
        (np.floor, "is left open"),
        (shuffled, "not of the same motion"),
    ):
        caught = raised(DegenerateError, words, clocked_of, restamped(session, stamp))
        assert "views.csv: stamp_s" in caught.culprits
    # Whatever is stated, one time is no time of all of them.
    with pytest.raises(DataError, match="no view has a pose of the robot"):
        calibrate(stating(restamped(session, np.zeros_like), AHEAD_S))
    # Rows in any order are as good, where each has the time of its own image.
    numbers = shuffled(len(session.views)).tolist()
    views = [replace(view, number=at) for view, at in zip(session.views, numbers, strict=True)]
    clock = clocked_of(replace(session, views=tuple(views))).clock
    assert abs(clock.camera_minus_robot_s - AHEAD_S) < 1e-4


def test_a_stream_of_another_time_is_named(session):
    late = with_robot_stamps(session, lambda s: s + 1e6)
    shuffled = restamped(late, np.random.default_rng(3).permutation)
    # One stamp of another epoch among the others, too: of so many offsets none is tried.
    apart = restamped(late, lambda s: np.where(np.arange(len(s)) == 3, 1.7e9, s))
    for seen in (shuffled, apart):
        raised(DataError, r"No view lies within streams/robot.csv", calibrate, seen)
    # Stated roughly, or not at all, as of a tracker and a camera that count from other days.
    clock = clocked_of(stating(late, 1.0 - 1e6)).clock
    assert abs(clocked_of(late).clock.camera_minus_robot_s - clock.camera_minus_robot_s) < 1e-6
    # Stamps of a million seconds have digits of a tenth of a nanosecond.
    assert abs(clock.camera_minus_robot_s + 1e6 - AHEAD_S) < 1e-4
    # The first samples and frames are of 1970, as of devices that have no clock of their own.
    moved = restamped(session, lambda s: s + 1.76e9 * (s > 0.5 + AHEAD_S))
    clock = clocked_of(with_robot_stamps(moved, lambda s: s + 1.76e9 * (s > 0.5))).clock
    assert abs(clock.camera_minus_robot_s - AHEAD_S) < 1e-4


def test_inverse_poses_are_named_where_the_clocks_stay_open(session):
    """As of a camera's poses in its target; the turning of both is the same."""
    inverse = []
    for view in session.views:
        row = pose_row(invert(view.cam_from_target().as_matrix())).values()
        inverse.append({**view.numbers, **dict(zip(MEASURED_CAM_POSE, row, strict=True))})
    read = with_rows(session, inverse)
    for stamp in (lambda s: s, lambda s: s + 1e6):
        words = "is left open by .* their inverse"
        caught = raised(DegenerateError, words, calibrate, with_robot_stamps(read, stamp))
        assert "--camera-inverse" in caught.next_step


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_target_moves_in_front_of_the_camera_as_finite_motion_has_it(mount):
    rng, step_s = np.random.default_rng(0), 1e-4
    x, z = (exp(rng.normal(size=6) * [0.3, 0.3, 0.3, 0.1, 0.1, 0.1]) for _ in range(2))
    flange, speeds = exp(rng.normal(size=(4, 6))), rng.normal(size=(4, 6))

    def seen(at_s):
        chain = flange @ exp(speeds * at_s)
        return invert(chain @ x) @ z if mount == "eye-in-hand" else invert(x) @ chain @ z

    twists = target_twists(mount, flange, x, seen(0.0), speeds)
    moved = log(invert(seen(-step_s)) @ seen(step_s)) / (2.0 * step_s)
    # Central differences of a screw motion are exact but for rounding.
    np.testing.assert_allclose(twists, moved, atol=1e-9)


def swept(seed=0, mount="eye-in-hand", how=SHORT, **options) -> SimulatedCell:
    return sweep(CellOptions(seed=seed, mount=mount, pixel_sigma_px=0.1, **options), how)


@pytest.fixture(scope="module")
def session() -> Session:
    return cell_session(swept(), "swept", seen="poses")


def with_rows(session: Session, rows) -> Session:
    """The session with other numbers in its views."""
    pairs = zip(session.views, rows, strict=True)
    return replace(session, views=tuple(replace(view, numbers=row) for view, row in pairs))


def restamped(session: Session, stamp) -> Session:
    """The session with the views' times as `stamp` makes them of (n,) times [s]."""
    stamps = stamp(np.array([view.stamp_s for view in session.views])).tolist()
    pairs = zip(session.views, stamps, strict=True)
    return with_rows(session, [{**view.numbers, "stamp_s": at} for view, at in pairs])


def with_robot_stamps(session: Session, stamp) -> Session:
    """The session with the times of the robot's stream as `stamp` makes them."""

    def change(robot):
        column = np.array(robot.columns) == "stamp_s"
        return np.where(column, stamp(robot.stamps_s)[:, None], robot.values)

    return with_stream(session, change)


@pytest.mark.parametrize(
    ("stamp", "words"),
    [
        (lambda s: s - 0.02 * (s >= s[200]), "from view 200 on it is -"),
        slow(lambda s: s + 1e-3 * (s - s[0]), "drifts against the robot's, by +"),
    ],
    ids=["back", "drift"],
)
def test_a_clock_that_changes_is_named_and_taken_out(stamp, words):
    # Of 20 s, long enough to tell how a clock runs.
    long = swept(how=SweepOptions())
    found = calibrate(restamped(cell_session(long, "swept", seen="poses"), stamp))
    cause = found.verdict.causes[0]
    assert cause.kind == "clock_changed"
    assert words in cause.words
    # Some frames about the jump are stamped in a mixed order; the rest is as without it.
    away = found.edges["flange_from_cam"].matrix - long.transforms["flange_from_cam"]
    assert np.linalg.norm(away[:3, 3]) < 3e-4


def test_the_offset_is_found_by_a_sweep():
    ahead_s = -0.61
    cell = swept(2, "eye-to-hand", replace(SHORT, camera_minus_robot_s=ahead_s))
    result = calibrate(cell_session(cell, "swept", seen="poses"))
    clock = result.clock
    assert clock.method == "motion"
    # A hundredth of what is asked for (2 ms), as told by some 200 frames; no error is beyond four
    # of its sigmas, and none of these is so small that this were easy.
    assert abs(clock.camera_minus_robot_s - ahead_s) < min(2e-4, 4 * clock.sigma_s)
    assert clock.sigma_s < 1e-4
    # Six degrees of freedom: one in ten thousand is beyond.
    assert misfit(result.edges["base_from_cam"], cell.transforms["base_from_cam"]) < 27.9
    # Poses that others measured say nothing of rows.
    assert clock.shutter is None


@pytest.mark.parametrize(
    ("seed", "how", "is_stated"),
    [
        pytest.param(0, SHORT, True, id="global", marks=pytest.mark.slow),
        pytest.param(1, HURRIED, True, id="rolling"),
        pytest.param(1, FAST, False, id="rolling before an open lens", marks=pytest.mark.slow),
    ],
)
def test_images_are_placed_in_time_by_their_corners_and_their_readout_is_found(
    seed, how, is_stated
):
    """A lens that is estimated of images whose rows are apart takes of the motion what it can."""
    cell = swept(seed, how=how, state_intrinsics=is_stated)
    known = calibrated_sweep(cell)
    result = result_of(known)
    clock, shutter = result.clock, result.clock.shutter
    assert abs(clock.camera_minus_robot_s - how.camera_minus_robot_s) < 1e-4
    assert shutter.kind == ("rolling" if how.readout_s else "global")
    # Four sigma, of which none is so large that this were easy: a hundredth of the readout.
    assert abs(shutter.readout_s - how.readout_s) < 4.0 * shutter.readout_sigma_s
    assert not how.readout_s or shutter.readout_sigma_s < 0.01 * READOUT_S
    assert any("rolling" in note for note in known.notes) == bool(how.readout_s)
    assert misfit(result.edges["flange_from_cam"], cell.transforms["flange_from_cam"]) < 27.9
    assert result.noise["pixel_px"] == pytest.approx(0.1, rel=0.05)
    assert result.verdict.status == "good"


def test_corners_move_with_the_readout_as_differences_say():
    moved = swept(how=replace(HURRIED, stops=3))
    stack = CornerStack.of(
        {corners.view: corners for corners in moved.corners},
        numbered_positions([moved.options.target]),
    )
    twists = np.random.default_rng(1).normal(size=(len(stack.views), 6))

    def delayed(by_s):
        return delayed_points(stack, moved.options.camera, twists, READOUT_S + by_s)

    # Places of 0.3 m at rounding over the step.
    difference = (delayed(1e-6)[0] - delayed(-1e-6)[0]) / 2e-6
    np.testing.assert_allclose(delayed(0.0)[1][:, :, 0], difference, atol=1e-8)


@pytest.mark.slow
def test_at_rest_the_clocks_do_not_matter():
    resting = dwelling(0.2)
    result = calibrate(resting)
    assert result.clock.method == "rest"
    assert result.clock.sigma_s is None
    words = "taken at rest, where this does not count"
    assert any(words in reason for reason in result.verdict.reasons)
    assert result.verdict.status == "good"
    assert sum(view.used for view in result.views) == 20
    # Nor that images share a time.
    again = [replace(view, number=view.number + 100) for view in resting.views]
    assert clocked_of(replace(resting, views=(*resting.views, *again))).clock.method == "rest"


SCREW = np.array([0.05, 0.1, 0.2, 0.01, 0.02, 0.005])


def going(way=lambda times_s: np.outer(times_s, SCREW), hz=30) -> Session:
    """A flange that goes a way: evenly about one axis, which no offset changes, or another one."""
    rng, times_s = np.random.default_rng(5), np.arange(0, 20, 0.02)
    frames_s = np.arange(3, 17, 1 / hz)
    x, z = exp(rng.normal(size=(2, 6)))
    noise = exp(1e-4 * rng.normal(size=(len(frames_s), 6)))
    seen = invert(exp(way(frames_s)) @ x) @ z @ noise
    return streamed((frames_s, seen), (times_s, exp(way(times_s))))


@pytest.mark.slow
def test_motion_that_repeats_itself_is_refused_unless_the_offset_is_stated():
    """Every two seconds."""
    turns, sizes = np.pi * np.array([1, 2, 1, 2, 1, 2]), np.array([0.4, 0.5, 0.3, 0.1, 0.1, 0.1])
    again = going(lambda s: np.sin(np.outer(s, turns) + np.arange(6)) * sizes, hz=10)
    words = "the motion repeats itself: offsets of .* ms explain it alike"
    raised(DegenerateError, words, clocked_of, again)
    # A period off, which is for whoever stated it, to 1 ms, to know.
    clock = clocked_of(stating(again, 2.05)).clock
    assert abs(clock.camera_minus_robot_s - 2.0) < 1e-3


def test_clocks_far_apart_are_named_where_no_offset_fits():
    why = why_undetermined((), (Match(0.3, 1.0),), 60.0)
    assert "at no offset of up to 5 s from the stated one" in why
    assert "?" not in why


@pytest.mark.slow
def test_motion_that_does_not_determine_the_offset_is_refused_unless_it_is_stated():
    # Its sigma would be longer than the recording.
    words = r"is left open by 420 views, of which 0 .* at rest: the motion says nothing of it"
    raised(DegenerateError, words, calibrate, going())
    clocked = clocked_of(stating(going(), 0.02))
    assert (clocked.clock.method, clocked.clock.sigma_s) == ("stated", 1e-3)
    assert "is taken as stated, +20 ms, to 1 ms" in clocked.warnings[0].words
    view = clocked.views[0]
    expected = exp((view.stamp_s - 0.02) * SCREW)
    np.testing.assert_allclose(view.base_from_flange().as_matrix(), expected, atol=1e-9)
    np.testing.assert_allclose(clocked.speeds[view.number], SCREW, atol=1e-7)


def test_times_in_another_unit_and_times_that_are_missing_are_named(session):
    for per_s, apart_s in ((1e3, 8), (1e6, 8000)):
        scaled = with_robot_stamps(session, lambda s, by=per_s: by * s)
        words = rf"streams/robot\.csv: by stamp_s its samples are {apart_s} s apart; .* in seconds"
        raised(DataError, words, calibrate, restamped(scaled, lambda s, by=per_s: by * s))
    rows = [{k: v for k, v in view.numbers.items() if k != "stamp_s"} for view in session.views]
    raised(DataError, "where a stream has the poses, stamp_s", calibrate, with_rows(session, rows))


@pytest.mark.slow
def test_uncertainty_of_the_clocks_counts(session):
    known, names = RunState(session), [stage.name for stage in STAGES]
    after = names.index("clock") + 1
    for stage in STAGES[:after]:
        known = stage.run(known)
    spreads = []
    for sigma_s in (1e-6, 1e-4, 5e-3):
        clocks = {
            pair: replace(clocked, clock=replace(clocked.clock, sigma_s=sigma_s))
            for pair, clocked in known.clocks.items()
        }
        later = replace(known, clocks=clocks)
        for stage in STAGES[after:]:
            later = stage.run(later)
        budget = result_of(later).uncertainty.budget_mm
        spreads.append((budget["clock"], budget["total"]))
    # The used views themselves tell the offset to 0.1 ms, but not for nothing: of one that is known
    # to 5 ms before, their noise counts, and no longer the clock's.
    (known_to_a_us, no_better, far_worse), totals = zip(*spreads, strict=True)
    assert max(known_to_a_us, far_worse) < 1e-3 < no_better
    assert totals[0] < totals[1] < totals[2]


def test_views_with_poses_of_their_own_ask_no_stream(session):
    pairs = zip(session.views, swept().robot.base_from_flange, strict=True)
    posed = with_rows(session, [view.numbers | pose_row(pose) for view, pose in pairs])
    result = calibrate(replace(posed, views=posed.views[::8]))
    assert result.clock is None
    assert all(view.used for view in result.views)
