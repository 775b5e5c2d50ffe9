"""Recording a live cell: what is taken, what is refused, and what is told of failures."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.live_cell import FakeArm, fake_devices, fake_plan
from support.recorded import QUICK, REPEATABILITY_M, errors_m, recorded

from visioncal.calibration.pipeline import run
from visioncal.core.errors import DataError, DriverError
from visioncal.core.transforms import compose
from visioncal.live.capture.assessment import JointPoseCheck
from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.gate import JointPace
from visioncal.live.capture.options import CaptureOptions, Stillness
from visioncal.live.capture.recording import checked_path, missed_stops, motion_summary
from visioncal.live.capture.take import image_motion_px
from visioncal.live.planning.cell import Box
from visioncal.live.planning.plan_file import PlanFile
from visioncal.session import Session


@pytest.fixture(scope="module")
def plan() -> PlanFile:
    return fake_plan(5)


def test_a_recording_is_a_session_that_calibrates(tmp_path):
    plan = fake_plan(12)
    arm, camera = fake_devices(plan)
    camera.factory = camera.lens
    steps = recorded(tmp_path / "live", plan, arm, camera, CaptureOptions(frames=2))
    session = Session.load(tmp_path / "live")
    assert session.warnings == ()
    assert [view.number for view in session.views] == [stop.view for stop in plan.stops]
    assert session.document["robot"]["model"] == "robot.toml"
    assert session.document["target"] == "charuco_9x6_30mm"
    row = session.views[0]
    assert {"current6_a", "temp6_c", "payload_z_m", "stamp_s", "q6_rad"} <= row.numbers.keys()
    assert row.text["safety"] == "normal"
    assert row.text["tcp"] == "0 0 0 0 0 0 1"
    assert row.text["device_exposure_us"] == "10000.0"
    # What was predicted becomes less with every view once something is determined.
    known = [step.accuracy.mm for step in steps if step.accuracy and not step.accuracy.is_open]
    assert len(known) > 5
    assert known == sorted(known, reverse=True)
    result = run(session).calibration
    truth = plan.cell.x
    off = result.transforms["flange_from_cam"].translation - truth[:3, 3]
    # Twelve small images with a tenth of a pixel of noise place the camera to well under 1 mm.
    assert np.linalg.norm(off) < 1e-3


def test_a_camera_that_stands_still_is_recorded_likewise(tmp_path):
    plan = fake_plan(3, mount="eye-to-hand")
    arm, camera = fake_devices(plan)
    recorded(tmp_path / "live", plan, arm, camera)
    session = Session.load(tmp_path / "live")
    assert session.mount == "eye-to-hand"
    assert len(session.views) == 3


@pytest.mark.parametrize("hidden", [False, True], ids=["told by the arm", "seen in the image"])
def test_a_moving_arm_gives_no_view(plan, tmp_path, hidden):
    arm, camera = fake_devices(plan, trembling_s=0.8, tremble_rad=4e-3, hidden=hidden)
    steps = recorded(tmp_path / "live", plan, arm, camera, CaptureOptions())
    session = Session.load(tmp_path / "live")
    assert len(session.views) == len(plan.stops)
    # It trembles by a millimetre and more at first, and the views waited for its end.
    assert max(errors_m(session, camera)) < REPEATABILITY_M
    assert all(step.settled_s > 0.8 for step in steps)


def test_an_arm_that_never_rests_gives_no_view(plan, tmp_path):
    arm, camera = fake_devices(plan, trembling_s=1e6, tremble_rad=1e-3)
    with pytest.raises(DataError, match=r"3 stops in a row.*nothing came to rest in 1 s"):
        recorded(
            tmp_path / "live",
            plan,
            arm,
            camera,
            replace(QUICK, still=Stillness(patience_s=1.0)),
        )
    assert not (tmp_path / "live" / "session.toml").exists()


def test_a_knock_between_frames_throws_all_of_them_away(plan, tmp_path):
    arm, camera = fake_devices(plan)
    frame, knocks = camera.frame, []

    def knocked(**words):
        # A knock that the encoders do not see, in the middle of the first view's frames.
        if camera.frames == 12 and not knocks:
            knocks.append(camera.frames)
            arm.hidden, arm.tremble_rad = True, 2e-3
            arm.trembling_s = arm.clock.now() - arm.begun + 0.5
        return frame(**words)

    camera.frame = knocked
    recorded(tmp_path / "live", plan, arm, camera, CaptureOptions(frames=8))
    session = Session.load(tmp_path / "live")
    assert knocks
    assert max(errors_m(session, camera)) < REPEATABILITY_M


def test_the_sharpest_frame_is_kept_or_the_mean(plan, tmp_path):
    for keep in ("sharpest", "mean"):
        arm, camera = fake_devices(plan)
        camera.noise = 6.0
        options = replace(QUICK, frames=6, keep=keep)
        recorded(tmp_path / keep, plan, arm, camera, options)
    means, singles = (
        np.std(_corner_of_first(tmp_path / keep).astype(float)) for keep in ("mean", "sharpest")
    )
    # Noise of 6 levels, and of 6 over the root of 6 with the rounding to whole levels.
    assert singles == pytest.approx(6.0, rel=0.15)
    assert means == pytest.approx(6.0 / np.sqrt(6.0), rel=0.15)


def _corner_of_first(folder) -> np.ndarray:
    """A part of the first image that shows nothing but the even backdrop."""
    image = cv2.imread(str(folder / "images" / "001.png"), cv2.IMREAD_GRAYSCALE)
    return image[:20, :40]


@pytest.mark.parametrize(
    ("failure", "words"),
    [
        ("gone", "link is lost"),
        ("protective-stop", "protective stop: .*"),
        ("emergency-stop", "emergency stop: .*"),
    ],
)
def test_a_failure_on_the_way_halts_and_leaves_a_session(plan, tmp_path, failure, words):
    arm, camera = fake_devices(plan)
    start, moves = arm.start_move, []

    def failing(q, **pace):
        start(q, **pace)
        moves.append(arm.clock.now())
        if len(moves) == 4:
            arm.failure, arm.fails_at = failure, 0.5

    arm.start_move = failing
    with pytest.raises(DriverError, match=words) as caught:
        recorded(tmp_path / "live", plan, arm, camera)
    assert arm.halted == 1
    # The watchdog looks every 20 ms, the failure came half a second after the start.
    assert arm.clock.now() - moves[-1] < 0.6
    assert "3 views are safe in" in caught.value.message
    assert "--resume" in caught.value.next_step or "cable" in caught.value.next_step
    assert len(Session.load(tmp_path / "live").views) == 3


def test_a_camera_that_is_unplugged_ends_the_recording(plan, tmp_path):
    arm, camera = fake_devices(plan)
    camera.unplugged_at = 4
    with pytest.raises(DriverError, match=r"no picture in 0\.5 s\. 3 views are safe"):
        recorded(tmp_path / "live", plan, arm, camera)
    assert arm.halted == 1
    assert Session.load(tmp_path / "live").views


def test_a_board_that_is_lost_once_is_told_and_three_times_ends(plan, tmp_path):
    arm, camera = fake_devices(plan)
    # The first move goes to the first stop.
    camera.hidden_at = (2,)
    steps = recorded(tmp_path / "once", plan, arm, camera)
    lost = missed_stops(steps)
    assert list(lost) == [2]
    assert "uniform" in lost[2]
    assert len(Session.load(tmp_path / "once").views) == len(plan.stops) - 1
    arm, camera = fake_devices(plan)
    camera.hidden_at = (2, 3, 4)
    with pytest.raises(DataError, match="no view at 3 stops in a row") as caught:
        recorded(tmp_path / "often", plan, arm, camera)
    assert "Look at the board" in caught.value.next_step
    assert "1 view is safe" in caught.value.message


def test_stale_joint_angles_are_no_view(plan, tmp_path):
    arm, camera = fake_devices(plan)
    start = arm.start_move

    def until_stale(q, **pace):
        start(q, **pace)
        # The watchdog would notice joints that do not arrive; here only a view reads them stale.
        arm.stale = ""

    arm.start_move = until_stale
    frame = camera.frame

    def stale_views(**words):
        if arm.moves == 3 and not arm.moving():
            arm.stale = "joints"
        return frame(**words)

    camera.frame = stale_views
    steps = recorded(tmp_path / "live", plan, arm, camera)
    lost = missed_stops(steps)
    assert list(lost) == [3]
    assert "joint" in lost[3]


def test_joints_and_poses_of_other_moments_disagree(plan):
    arm, _ = fake_devices(plan)
    states = []
    for stop in plan.stops[:3]:
        arm.q0 = stop.q
        states.append(arm.state())
    told = JointPoseCheck(plan.cell.robot)
    assert told.why_not(states[0]) == ""
    assert told.why_not(states[1]) == ""
    stale = replace(states[2], q=states[1].q)
    assert "so the joint angles are stale" in told.why_not(stale)
    stale = replace(states[2], base_from_flange=states[1].base_from_flange)
    assert "so the pose is stale" in told.why_not(stale)
    # Another base than the model's, and a tool on its flange, are no disagreement.
    for other in (JointPoseCheck(plan.cell.robot), JointPoseCheck(plan.cell.robot)):
        offset = compose(np.diag([-1.0, -1.0, 1.0]), np.array([0.1, 0.0, 0.2]))
        for state in states:
            moved = offset @ state.base_from_flange
            assert other.why_not(replace(state, base_from_flange=moved)) == ""
    few = replace(states[0], q=np.zeros(4))
    assert "4 joints, and ur5e has 6" in told.why_not(few)


def test_motion_takes_its_time():
    pace = JointPace(0.5, 1.0)
    # 1 rad at 0.5 rad/s and 1 rad/s^2: half a second up, half a second down, 1.5 s in between.
    assert pace.travel_s(np.zeros(2), np.array([1.0, 0.2])) == pytest.approx(2.5)
    assert pace.travel_s(np.zeros(1), np.array([0.01])) == pytest.approx(0.2)


def test_an_arm_that_hangs_or_ends_elsewhere_is_told(plan, tmp_path):
    arm, camera = fake_devices(plan)
    arm.moving = lambda: arm.clock.sleep(0.01) or True
    with pytest.raises(DriverError, match=r"still moving after .* s, where .* s were expected"):
        recorded(tmp_path / "hangs", plan, arm, camera)
    assert arm.halted == 1
    arm, camera = fake_devices(plan)
    arm.start_move = lambda *_, **__: None
    with pytest.raises(DriverError, match=r"the motion ended .* deg before its goal in joint"):
        recorded(tmp_path / "elsewhere", plan, arm, camera)


def test_ways_from_elsewhere_are_looked_at(plan):
    first, second = plan.stops[:2]
    assert len(checked_path(plan, first, first.q)) == 1
    assert np.array_equal(checked_path(plan, second, first.q)[-1], second.q)
    # A box where the goal's flange is lets no way lead there.
    far = next(stop for stop in plan.stops if np.abs(stop.q - first.q).max() > 0.5)
    flange = plan.cell.robot.base_from_flange(far.q[None])[0]
    box = Box("post", compose(np.eye(3), flange[:3, 3]), np.full(3, 0.02))
    walled = replace(plan, cell=replace(plan.cell, boxes=(box,)))
    with pytest.raises(DataError, match=r"no clear way leads there .*post"):
        checked_path(walled, far, first.q + 0.1)


def test_a_plan_for_another_arm_is_not_driven(plan):
    arm, camera = fake_devices(plan)
    other = fake_plan(3)
    moved = FakeArm(other.cell, arm.clock, plan.stops[0].q)
    state, offset = moved.state, compose(np.eye(3), np.array([0.3, 0.0, 0.0]))
    moved.state = lambda: replace(said := state(), base_from_flange=offset @ said.base_from_flange)
    with pytest.raises(DataError, match=r"its flange is 300 mm and 0 deg from where the model"):
        motion_summary(LiveCell(moved, (camera,), arm.clock), plan, (), QUICK)


def test_images_that_move_are_measured_to_a_hundredth_of_a_pixel():
    _, camera = fake_devices(fake_plan(1))
    camera.noise = 0.0
    still = camera.frame().image
    assert image_motion_px(still, still) == 0.0
    moved = np.roll(still, 3, axis=1)
    # Points at the rim leave the image; the others say three pixels.
    assert image_motion_px(still, moved) == pytest.approx(3.0, abs=0.05)
    assert image_motion_px(still, np.full_like(still, 90)) == float("inf")
    assert image_motion_px(np.full_like(still, 90), still) == 0.0
    camera.noise = 2.0
    # Fresh noise of two levels moves the median point by far less than what is taken for still.
    assert image_motion_px(camera.frame().image, camera.frame().image) < 0.05
