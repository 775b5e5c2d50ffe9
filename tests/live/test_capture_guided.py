"""Recording an arm that a person moves, and what they are told."""

import numpy as np
import pytest
from support.live_cell import FakeArm, FakeCamera, fake_devices, fake_plan
from support.recorded import QUICK, REPEATABILITY_M, errors_m, facts_of

from visioncal.calibration.stages.detect import find_corners
from visioncal.core.types import Corners
from visioncal.live.capture.assessment import Coach
from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.journal import Journal
from visioncal.live.capture.recording import Capture, CaptureEvent, ask_and_take, follow
from visioncal.live.capture.take import TakenView
from visioncal.live.planning.plan_file import PlanFile
from visioncal.session import Session


@pytest.fixture(scope="module")
def plan() -> PlanFile:
    return fake_plan(5)


def test_the_coach_asks_for_what_is_missing(plan):
    lens = fake_devices(plan)[1].lens
    coach = Coach(plan.cell.target, lens.resolution, lens)
    assert coach.advice() == "another place, with the board large in the image"
    ids = np.arange(40)
    board = np.stack(np.meshgrid(np.arange(8), np.arange(5)), axis=-1).reshape(-1, 2)
    for view in range(3):
        # Straight from above, in the upper left of the image.
        coach.add(Corners(view, ids, 20.0 + 25.0 * board + view, 0.7))
    assert "steepest view leans by 0 deg only" in coach.advice()
    assert coach.words().startswith("coverage 15 %, tilts to 0 deg")
    for view, stop in enumerate(plan.stops):
        arm, camera = fake_devices(plan)
        arm.q0 = stop.q
        found, _ = find_corners(camera.frame().image, plan.cell.target, view)
        coach.add(found)
    assert "right" in coach.advice() or "bottom" in coach.advice()


class Hand:
    """Leads an arm to the next place as soon as a view is there; in the end it presses Ctrl-C."""

    def __init__(self, arm: FakeArm, places: list[np.ndarray]) -> None:
        self.arm, self.places = arm, iter(places)

    def stepped(self, _: CaptureEvent) -> None:
        """Leads it on."""
        place = next(self.places, None)
        if place is None:
            raise KeyboardInterrupt
        self.arm.start_move(place, speed=2.0, acceleration=4.0)


def test_a_guided_arm_gives_a_view_wherever_it_rests(plan, tmp_path):
    arm, camera = fake_devices(plan)
    capture = _capture(tmp_path / "live", plan, arm, camera)
    # It begins at the first of them.
    places = [stop.q for stop in plan.stops[1:]]
    capture.watchers = (Hand(arm, places),)
    steps = follow(capture, len(plan.stops))
    assert len(steps) == len(plan.stops)
    session = Session.load(tmp_path / "live")
    assert [view.number for view in session.views] == list(range(1, len(plan.stops) + 1))
    assert max(errors_m(session, camera)) < REPEATABILITY_M


def test_an_arm_that_is_led_on_before_it_settles_gives_no_view_twice(plan, tmp_path):
    arm, camera = fake_devices(plan)
    capture = _capture(tmp_path / "live", plan, arm, camera)
    frame = camera.frame

    def led(**words):
        # The first frame of all: the hand goes on to another place, and from there to a third.
        if camera.frames == 0:
            arm.start_move(plan.stops[1].q, speed=2.0, acceleration=4.0)
        return frame(**words)

    camera.frame = led
    capture.watchers = (Hand(arm, [plan.stops[1].q + 0.001, plan.stops[2].q]),)
    state, last = arm.state, plan.stops[2].q

    def led_on():
        # After some seconds at the place that has its view it goes to a third.
        if arm.moves == 2 and arm.clock.now() - arm.begun > 5.0:
            arm.start_move(last, speed=2.0, acceleration=4.0)
        return state()

    arm.state = led_on
    follow(capture, 2)
    poses = [view.base_from_flange().translation for view in Session.load(tmp_path / "live").views]
    assert np.linalg.norm(poses[1] - poses[0]) > 0.02


def test_ctrl_c_ends_a_guided_recording(plan, tmp_path):
    arm, camera = fake_devices(plan)
    capture = _capture(tmp_path / "live", plan, arm, camera)
    capture.watchers = (Hand(arm, [plan.stops[1].q]),)
    assert len(follow(capture, 0)) == 2
    assert len(Session.load(tmp_path / "live").views) == 2


def test_typed_poses_make_a_session(plan, tmp_path):
    arm, camera = fake_devices(plan)
    capture = _capture(tmp_path / "live", plan, arm, camera)
    answers, asked = iter(["", "", "", "q"]), []
    places = iter(plan.stops)

    def ask(question: str) -> str:
        asked.append(question)
        answer = next(answers)
        if answer == "":
            arm.q0 = next(places).q
        return answer

    steps = ask_and_take(capture, arm, 0, ask)
    assert all(isinstance(step.found, TakenView) for step in steps)
    assert "View 1 (another place" in asked[0]
    assert len(Session.load(tmp_path / "live").views) == 3


def _capture(folder, plan: PlanFile, arm: FakeArm, camera: FakeCamera) -> Capture:
    journal = Journal.begin(folder, facts_of(plan, arm, camera), arm.clock.unix_offset_s(), 0)
    cell = LiveCell(arm, (camera,), arm.clock)
    planned = plan.cell
    return Capture(cell, planned.target, planned.robot, camera.lens, journal, QUICK, None)
