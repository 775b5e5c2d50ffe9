"""What is said of a cause is earned: its cure is applied, and leaves what its rivals do not."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from benchmarks import elsewhere
from scipy.spatial.transform import Rotation
from support.cells import calibrated, pairs_session, reporting, showing
from support.marks import slow
from support.misfits import misfit
from support.refusals import raised
from support.sound_findings import SOUND, changed, directions

import visioncal
from visioncal.calibration.pipeline.judging import findings_of
from visioncal.calibration.pipeline.result import result_of, view_evidence
from visioncal.calibration.suspects.contest import contested
from visioncal.calibration.suspects.judge import judge
from visioncal.calibration.suspects.judged import Findings, JudgedArm
from visioncal.calibration.suspects.limits import few_stops
from visioncal.calibration.suspects.ranking import rank_causes
from visioncal.core.errors import DegenerateError
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.transforms import compose, exp, invert
from visioncal.core.types import MOUNTS
from visioncal.core.verdict import LEFT_OPEN, Finding, Verdict
from visioncal.simulation import BOARDS, CAMERAS, CellOptions, simulate
from visioncal.verification.calibration_prior import CalibrationPrior

FINE = CellOptions(camera=CAMERAS["fine"], pixel_sigma_px=0.1)
_GRID = np.stack(np.meshgrid(np.arange(7), np.arange(5)), -1).reshape(-1, 2)
PLACES = np.pad(0.03 * _GRID, ((0, 0), (0, 1)))
LENS = np.array([[900.0, 0.0, 640.0], [0.0, 900.0, 360.0], [0.0, 0.0, 1.0]])


def pairs(seed, mount, views=18, step=None, farther_m=0.0):
    """Poses of a robot, and those that OpenCV finds from corners with 0.3 px of noise.

    From view 9 on, the target is elsewhere by a twist, or distances are measured too long.
    """
    rng = np.random.default_rng([seed, 99])
    x = exp(np.r_[rng.normal(0.0, 0.5, 3), rng.normal(0.0, 0.06, 3)])
    far = [0.5, 0.1, 0.0] if mount == MOUNTS[0] else rng.normal(0.0, 0.1, 3)
    z, robot, seen = exp(np.r_[rng.normal(0.0, 1.0, 3), far]), [], []
    while len(seen) < views:
        away, tilt, about = rng.uniform([0.35, 0.05, 0.0], [0.9, 0.6, 2.0 * np.pi])
        turns = np.zeros((4, 6))
        turns[:, :3] = [
            [0.0, 0.0, rng.uniform(-1.5, 1.5)],
            [tilt * np.cos(about), tilt * np.sin(about), 0.0],
            [np.pi, 0.0, 0.0],
            [0.0, 0.0, rng.uniform(-0.5, 0.5)],
        ]
        turn = np.linalg.multi_dot(exp(turns)[:, :3, :3])
        middle = np.array([*(away * rng.uniform([-0.12, -0.08], [0.12, 0.08])), away])
        camera = compose(turn, middle - turn @ PLACES.mean(axis=0))
        seen_pose = camera if step is None or len(seen) < 9 else camera @ exp(np.array(step))
        px = (PLACES @ seen_pose[:3, :3].T + seen_pose[:3, 3]) @ LENS.T
        px = px[:, :2] / px[:, 2:]
        if ((px < 5.0) | (px > [1275.0, 715.0])).any():
            continue
        _, turned, placed = cv2.solvePnP(PLACES, px + rng.normal(0.0, 0.3, px.shape), LENS, None)
        placed[2] += farther_m * (len(seen) >= 9)
        seen.append(compose(cv2.Rodrigues(turned)[0], placed[:, 0]))
        pose = z @ invert(camera) @ invert(x) if mount == MOUNTS[0] else x @ camera @ z
        robot.append(pose @ exp(rng.normal(0.0, 2e-5, 6)))
    return pairs_session(mount, np.array(robot), np.array(seen))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [121, 115, 123, 138, *range(20, 30)])
@pytest.mark.parametrize("mount", MOUNTS)
def test_uneven_noise_is_no_step(mount, seed):
    """Views far away have more of it; in the first sessions several are on one side."""
    causes = visioncal.calibrate(pairs(seed, mount)).verdict.causes
    assert not {cause.kind for cause in causes} & {"moved_at_once", "board_changed"}


@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
def test_distances_that_change_at_once_are_no_noise(mount):
    """As noise along the sight, which has a size of its own, they would be let pass."""
    verdict = visioncal.calibrate(pairs(20, mount, farther_m=4e-3)).verdict
    assert verdict.status == "check"
    cause = verdict.causes[0]
    assert cause.kind in ("moved_at_once", "board_changed")
    assert "from view 9 on" in cause.words
    assert "or what measures its poses" in cause.words


def test_the_size_of_an_exact_table_of_points_is_tried_as_any_cure():
    """A sheet of tags that is 0.2 % larger than its table: without its size, noise is more."""
    cell = simulate(CellOptions(views=20, target=BOARDS["tags"], board_scale=1.002))
    (cause, *_) = calibrated(cell, joints=False).verdict.causes
    assert cause.kind == "board_size"
    pattern = r"leaves noise of (?:under )?(\S+) mm.* else it is (\S+) mm"
    left, without = map(float, re.search(pattern, cause.without_it).groups())
    # The residuals by distance are some tenths of a millimetre, and the arm's noise 0.03 mm.
    assert 2.0 * left < without


def lifted(cell):
    """The cell whose base is elsewhere by 1 mm from the middle on."""
    twists = np.zeros((len(cell.corners), 6))
    twists[len(twists) // 2 :, 5] = 1e-3
    return reporting(cell, base_from_flange=exp(twists) @ cell.robot.base_from_flange)


def test_a_cause_is_sure_where_its_cure_leaves_noise():
    known = calibrated(lifted(simulate(FINE)))
    cause = known.verdict.causes[0]
    assert cause.kind == "moved_at_once"
    assert not cause.by_limit
    assert "Applied and refitted, it leaves noise of" in cause.without_it
    # Beside another step about as likely, which its sentence names, it is the likeliest.
    (step,) = known.assessment.steps
    two_steps = replace(known.assessment, steps=(step, step))
    assert judge(findings_of(replace(known, assessment_or_none=two_steps))).causes[0].by_limit
    # Nor beside corners that show another lens from there on.
    lens = Finding("focus", "The lens changed at once.", mahalanobis_sq=2.0 * cause.mahalanobis_sq)
    (moved, _) = contested(known, [cause, lens])
    assert not moved.is_proven


@pytest.mark.parametrize(
    ("mount", "first", "by_m"),
    [
        (MOUNTS[0], 10, 1e-3),
        (MOUNTS[1], 17, 1e-3),
        slow(MOUNTS[0], 17, 1e-3),
        slow(MOUNTS[1], 14, 2e-3),
        slow(MOUNTS[1], 8, 4e-3),
        slow(MOUNTS[0], 12, 6e-3),
    ],
)
def test_a_camera_that_moved_once_is_where_it_stood_last(mount, first, by_m):
    """Picks come after the session, whether views after the step are used or left out."""
    options = replace(FINE, mount=mount, views=20, seed=4)
    cell, moved = simulate(options), simulate(replace(options, camera_moved_m=by_m))
    known = calibrated(showing(cell, [*cell.corners[:first], *moved.corners[first:]]), joints=False)
    cause = known.verdict.causes[0]
    assert cause.kind in ("moved_at_once", "something_moved")
    assert "has it where it " in cause.words
    edge, limit = known.assessment.edges["cam"], chi2_limit(FALSE_ALARM, 6)
    (before, still), (after, _) = ([*one.transforms.values()] for one in (cell, moved))
    assert misfit(edge, after) < limit < misfit(edge, before)
    assert misfit(known.assessment.edges["target"], still) < limit
    # A check of later stops reads transforms, lens and board as one.
    prior = CalibrationPrior.of(result_of(known))
    assert prior.state.edges[0] == pytest.approx(edge.matrix)


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_residuals_and_noise_beside_a_step_are_those_of_the_result(mount):
    """A camera that moved leaves what it would have left had it stood still."""
    options = replace(FINE, mount=mount, views=20, seed=4)
    cell, moved = simulate(options), simulate(replace(options, camera_moved_m=1e-3))
    mixed = showing(cell, [*cell.corners[:10], *moved.corners[10:]])
    still, stepped = (calibrated(one, joints=False) for one in (cell, mixed))
    before, after = map(result_of, (still, stepped))
    # A second pose of the camera takes six more values of 20 views.
    assert after.rms.mm < 1.1 * before.rms.mm
    assert after.rms.px < 1.1 * before.rms.px
    assert after.validation.held_out.mm < 1.2 * before.validation.held_out.mm
    assert max(view.residual_mm for view in after.views) < 1.0
    low_mm, high_mm = before.uncertainty.noise_95["robot_translation_mm"]
    assert low_mm < after.noise["robot_translation_mm"] < high_mm
    # What the viewer and the report draw over each image.
    away = [each.predicted_px - each.corners.px for each in view_evidence(stepped)]
    assert np.sqrt(np.mean(np.concatenate(away) ** 2)) < 1.1 * after.rms.px


@pytest.mark.parametrize(("joint", "by_deg"), [(1, 0.3), slow(0, 0.3)])
def test_a_joint_that_slipped_unseen_is_among_what_may_have_moved(joint, by_deg):
    """No frame is accused alone of an arm whose joints are not in the table."""
    cell = simulate(replace(FINE, seed=2))
    joints = cell.robot.joints.copy()
    joints[len(joints) // 2 :, joint] -= np.deg2rad(by_deg)
    reported = cell.robot.flange_at(joints, cell.robot.loads)
    cause = calibrated(reporting(cell, base_from_flange=reported), joints=False).verdict.causes[0]
    assert cause.kind in ("moved_at_once", "something_moved")
    assert "joint" in cause.words


def test_a_camera_that_moved_twice_is_named_with_the_frame_of_either_change():
    """Coarse poses of a marker leave no view out, and each change is more than an arm errs by."""
    rng, twists = np.random.default_rng(0), np.zeros((3, 6))
    twists[1:, 2:] = [[0.0, 0.012, 0.006, 0.0], [0.01, -0.012, 0.008, 0.004]]
    spread = rng.normal(size=(45, 6)) * np.repeat([0.3, 0.1], 3)
    robot = exp(spread + np.array([3.0, 0.0, 0.0, 0.6, 0.0, 0.4]))
    edges = exp(np.array([[0.1, 0.2, -1.5, 0.03, 0.05, 0.1], [3.0, 0.1, 0.2, 0.6, 0.1, 0.0]]))
    noise = exp(rng.normal(size=(45, 6)) * np.repeat([6e-3, 4e-3], 3))
    seen = invert(robot @ edges[0] @ exp(twists)[np.arange(45) // 15]) @ edges[1] @ noise
    session = pairs_session("eye-in-hand", robot, seen)
    (words,) = (
        cause.words
        for cause in visioncal.calibrate(session).verdict.causes
        if cause.kind == "moved_at_once"
    )
    assert words.startswith("The camera moved at once, twice: from view 15 on, it is ")
    assert ", or the controller's tool is another one, by (" in words


@pytest.mark.parametrize(
    ("by", "share", "words"),
    [
        (-1, 0.006, "the image was taken before the arm had arrived, as of commanded poses"),
        (-1, -0.01, "the pose was read before the arm had arrived"),
        (1, 0.008, "the image was taken once the arm had left"),
    ],
)
def test_an_arm_on_its_way_at_some_stops_is_named(by, share, words):
    """At every third stop; a tool moves along lines, and turns about one axis."""
    cell = simulate(CellOptions(seed=4, views=24, robot_sigma_m=2e-5, robot_sigma_rad=5e-5))
    robot, stops = cell.robot.base_from_flange.copy(), np.arange(2, 23, 3)
    poses, others = cell.robot.base_from_flange[stops], cell.robot.base_from_flange[stops + by]
    turns = Rotation.from_matrix(invert(poses)[:, :3, :3] @ others[:, :3, :3]).as_rotvec()
    # The picture is taken where the cell has the arm: what is logged is off that.
    robot[stops, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(-share * turns).as_matrix()
    robot[stops, :3, 3] -= share * (others - poses)[:, :3, 3]
    verdict = calibrated(reporting(cell, base_from_flange=robot), joints=False).verdict
    cause = verdict.causes[0]
    assert cause.kind == "something_moved"
    assert words in cause.words
    assert {*cause.views} <= {*stops.tolist()}
    # One stop in seven may stand beside a neighbour in the same place.
    assert len(cause.views) >= len(stops) - 1


@pytest.mark.slow
def test_a_small_step_of_an_arm_without_joints_may_be_its_other_posture():
    """An arm that goes over to its other shoulder has its errors the other way at once."""
    cause = calibrated(lifted(simulate(FINE)), joints=False).verdict.causes[0]
    assert cause.kind == "moved_at_once"
    assert "or the arm went over to another posture (shoulder, elbow or wrist)" in cause.words
    # The cure leaves mere noise, and so would errors of the arm.
    assert cause.by_limit


@pytest.mark.slow
def test_a_cause_without_a_tried_cure_is_not_certain():
    """No fit of an arm's links is possible without its joint angles."""
    cell = simulate(replace(FINE, dh_sigma_m=5e-4, dh_sigma_rad=1e-3))
    known = calibrated(cell, joints=False)
    found = [cause for cause in known.verdict.causes if cause.kind == "arm_errors"]
    assert found
    assert all(cause.by_limit for cause in found)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_creeping_is_not_sure_where_a_step_does_as_well(seed):
    """A target that moved by 1.1 mm midway."""
    step = [0.0, 0.0, 0.0, 1e-3, 5e-4, 0.0]
    for cause in visioncal.calibrate(pairs(seed, MOUNTS[0], step=step)).verdict.causes:
        assert cause.by_limit or cause.is_share or cause.kind == "moved_at_once"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 1])
def test_a_camera_that_slowly_turns_is_no_lens_that_surely_changed(seed):
    """By a milliradian: its picture moves by a pixel, as by a lens whose centre does."""
    cell = simulate(CellOptions(views=30, seed=seed, pixel_sigma_px=0.3))
    camera, twists = cell.transforms["flange_from_cam"], np.zeros((30, 6))
    twists[:, 0] = np.linspace(0.0, 1e-3, 30)
    flange = cell.robot.base_from_flange @ camera @ exp(twists) @ invert(camera)
    (cause, *_) = calibrated(reporting(cell, base_from_flange=flange)).verdict.causes
    assert cause.by_limit
    # The truth may be named alone, where no lens does about as well, and stands beside a lens.
    is_named = cause.words.startswith("The load on the flange crept")
    assert is_named or "what the flange carries crept" in cause.rivals


@pytest.mark.slow
def test_no_cause_explains_more_than_its_size_allows():
    """A base that creeps by 40 mm, and as is likelier, whatever else follows the order of views."""
    cell = simulate(FINE)
    time = np.linspace(-0.5, 0.5, len(cell.corners))[:, None]
    crept = exp(0.04 * time * np.eye(6)[4]) @ cell.robot.base_from_flange
    causes = calibrated(reporting(cell, base_from_flange=crept)).verdict.causes
    assert not {cause.kind for cause in causes} & {"moved_slowly", "base_creeps"}


def test_fewer_stops_than_check_a_result_accuse_no_arm():
    cell = simulate(replace(FINE, views=9, dh_sigma_m=5e-4, dh_sigma_rad=1e-3))
    known = calibrated(cell, joints=False)
    # It counts in the covariance as ever.
    assert any(arm.errors.is_significant for arm in known.cell_fit.arms.values())
    assert not any("posture" in finding.words for finding in known.verdict.findings)


@pytest.mark.parametrize(("explains", "first"), [(0.9, "board_shape"), (0.3, "unexplained")])
def test_an_error_in_the_fit_explains_the_misfit_that_it_removed(explains, first):
    bent = Finding("board_shape", "The board is not flat.", explains=explains)
    verdict = judge(changed(SOUND, warnings=(bent,), noise_mm=1.0))
    assert verdict.causes[0].kind == first


def test_a_bent_board_that_is_in_the_fit_is_no_cause_of_a_weak_motion():
    bent = Finding("board_shape", "The board is not flat.")
    verdict = judge(replace(changed(SOUND, warnings=(bent,)), worst=directions(9e-3)))
    assert [cause.kind for cause in verdict.causes][:1] == ["weak_motion"]


def moving(kind, mount, count=16):
    """Pairs of a machine that cannot tilt, and the camera's true transform."""
    rng = np.random.default_rng(1)
    places = rng.uniform([0.3, -0.3, 0.2], [0.6, 0.3, 0.5], (count, 3))
    turns = np.zeros((count, 3))
    if kind == "rail":
        places[:, 1:] = [0.0, 0.4]
    if kind == "scara":
        turns[:, 2] = rng.uniform(-1.5, 1.5, count)
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    robot = compose(exp(np.pad(turns, ((0, 0), (0, 3))))[:, :3, :3], places) @ down
    x = exp(np.r_[rng.normal(0.0, 0.3, 3), 0.05, -0.03, 0.08])
    z = exp(np.r_[rng.normal(0.0, 0.5, 3), 0.5, 0.1, 0.0])
    seen = invert(x) @ (invert(robot) if mount == MOUNTS[0] else robot) @ z
    noise = rng.normal(0.0, 1.0, (count, 6)) * np.repeat([5e-4, 2e-4], 3)
    return pairs_session(mount, robot, seen @ exp(noise)), {"cam": x, "target": z}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "mount", "name", "keys"),
    [
        ("gantry", MOUNTS[0], "base_from_target", "xyz"),
        ("gantry", MOUNTS[1], "flange_from_target", "xyz"),
        ("scara", MOUNTS[0], "flange_from_cam", "z"),
        ("scara", MOUNTS[1], "base_from_cam", "z"),
    ],
)
def test_a_machine_that_cannot_tilt_is_asked_for_a_measured_height(kind, mount, name, keys):
    session, true = moving(kind, mount)
    error = raised(DegenerateError, "not determined at all", visioncal.calibrate, session)
    assert f"[prior.{name}]" in error.next_step
    assert all(f"{key}_m" in error.next_step for key in keys)
    values = dict(zip("xyz", true[name.rpartition("_")[2]][:3, 3].tolist(), strict=True))
    prior = {f"{key}_m": values[key] for key in keys} | {"sigma_m": 5e-4}
    measured = session.with_content(document=session.document | {"prior": {name: prior}})
    found = visioncal.calibrate(measured)
    camera = "flange_from_cam" if mount == MOUNTS[0] else "base_from_cam"
    away = found.edges[camera].matrix[:3, 3] - true["cam"][:3, 3]
    # Three sigma of what was measured, beside little noise.
    assert np.linalg.norm(away) < 1.5e-3
    # Nobody is told to tilt what cannot.
    assert not any("tilted" in str(step) for step in found.verdict.next_steps)


@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
def test_a_rail_leaves_a_turn_open_too(mount):
    error = raised(
        DegenerateError, "in position only", visioncal.calibrate, moving("rail", mount)[0]
    )
    assert "move along a second direction" in error.next_step


@pytest.mark.slow
def test_a_lens_that_far_views_leave_open_is_refused_with_the_keys_to_state():
    far = CellOptions(
        views=14, seed=1, state_intrinsics=False, distance_m=(2.8, 3.2), pixel_sigma_px=0.3
    )
    cell = simulate(far)
    known = calibrated(cell)
    found, lens, true = known.assessment.edges["cam"], known.lenses["cam"], CAMERAS["wide"].matrix
    assert np.allclose(lens.camera.matrix[:2], true[:2], atol=14.0)
    # The motion tells the focal length to a per cent, and the views alone not to five.
    assert np.sqrt(np.diag(lens.covariance)[:2].max()) < 0.01 * true[0]
    assert found.sigma_mm > 1.0
    assert misfit(found, cell.transforms["flange_from_cam"]) < 22.5
    (words,) = (note for note in known.notes if "robot's motion determined the lens" in note)
    assert "over 5 % of the image's width" in words
    assert "role = intrinsics" in words


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 7])
def test_a_base_that_creeps_before_a_fixed_camera_is_among_what_is_named(seed, tmp_path):
    """By 0.5 mm along the line of sight, as a lens that creeps or a board that shrinks.

    Beside independent noise alone, these and a lens that changed at once explained more.
    """
    world = elsewhere.World(lift=lambda share: 5e-4 * share, views=30)
    elsewhere.cell(world, MOUNTS[1], seed % 2 == 0, seed, tmp_path / "cell")
    verdict = visioncal.calibrate(tmp_path / "cell").verdict
    (cause, *_) = verdict.causes
    assert cause.kind == "base_creeps" or "the base, or what stands in it, crept" in cause.words
    assert cause.kind == "base_creeps" or verdict.top[0].startswith("Likeliest of these")


@pytest.mark.slow
def test_a_lens_that_was_zoomed_far_is_not_one_that_varies(tmp_path):
    """By 4 % midway: beside errors that last, it gains less than one that varies does alone."""

    def zoomed(far, _):
        return 1.0 + 0.04 * (np.arange(len(far)) >= len(far) // 2)

    folder = tmp_path / "cell"
    elsewhere.cell(elsewhere.World(focus=zoomed, views=18), MOUNTS[0], False, 1, folder)
    cause = visioncal.calibrate(folder).verdict.causes[0]
    assert "The lens changed at once" in cause.words
    assert "from view 9 on" in cause.words


def test_the_rest_of_a_misfit_is_unexplained_by_no_less_than_its_cause():
    """Motions stop short, by which most of the misfit goes; what remains is no other fault."""
    short = Finding("stops_short", "Motions stop short.", mahalanobis_sq=400.0, is_apart=True)
    rest = Finding("unexplained", "A flange that is off.")
    first, second = rank_causes([short, rest], (), None)
    assert first.probability > 0.9
    assert second.probability < 0.05


@pytest.mark.parametrize("share", [0.1, 0.9])
def test_a_cure_that_hardly_helps_is_not_most_likely(share):
    """Of a finding that is significant; its cure leaves as much."""
    found = Finding("lens_grows", "The lens.", mahalanobis_sq=40.0, explains=share)
    (ranked,) = rank_causes([found], (), None)
    said = Verdict("check", (ranked,)).top[0]
    assert said == f"{'Most likely' if share > 0.5 else 'Possibly'}: The lens."


def test_the_number_of_views_is_no_cause():
    (few,) = few_stops(Findings((), (), (JudgedArm(9),), ()), 9)
    (ranked,) = rank_causes([few], (), None)
    assert ranked.probability
    assert Verdict("check", (ranked,)).top[0].startswith("Only 9 views are used")


def test_words_say_whether_rivals_are_left():
    first = Finding("lens", "The lens.", probability=0.9, by_limit=True)
    other = replace(first, words="The board.", probability=0.1)
    assert Verdict("bad", (first, other)).top[0] == "Likeliest of these: The lens."
    assert Verdict("bad", (first,)).top[0] == "Most likely: The lens."
    left_open = replace(first, words=f"The lens.{LEFT_OPEN} the board grew.")
    assert Verdict("bad", (left_open,)).top[0].startswith("Likeliest of these: The lens.")
    proven = replace(first, by_limit=False, without_it="It leaves nothing.")
    said = "Most likely (90 %): The lens. It leaves nothing."
    assert Verdict("bad", (proven, other)).top[0] == said


@pytest.mark.slow
def test_errors_of_an_arm_explain_what_the_cure_of_a_lens_leaves():
    """The stated lens is another camera's; it was refined, and the arm errs as arms do."""
    cell = simulate(replace(FINE, views=24, seed=4, dh_sigma_m=1e-4, dh_sigma_rad=1e-4))
    for off, first in ((0.0, "arm_errors"), (15.0, "lens")):
        ((name, lens),) = cell.stated.items()
        other = replace(lens, matrix=lens.matrix + off)
        found = calibrated(replace(cell, stated={name: other}), joints=False).verdict
        assert found.causes[0].kind == first
        assert "arm_errors" in {finding.kind for finding in found.findings}


@pytest.mark.parametrize("mount", [MOUNTS[1], slow(MOUNTS[0])])
def test_a_camera_that_moved_twice_is_no_base_that_creeps(mount):
    """Two steps of 1.5 mm one way follow time, too, and a creep in the fit would hide them."""
    options = replace(FINE, mount=mount, views=24, seed=4, pixel_sigma_px=0.2)
    shifts = (0.0, 1.5e-3, 3e-3)
    cells = [simulate(replace(options, camera_moved_m=by_m)) for by_m in shifts]
    corners = [cells[(at >= 9) + (at >= 17)].corners[at] for at in range(24)]
    known = calibrated(showing(cells[0], corners), joints=False)
    (cause, *_) = known.verdict.causes
    assert cause.kind == "moved_at_once"
    assert "moved at once, twice: from view 9 on, " in cause.words
    after = next(iter(cells[-1].transforms.values()))
    assert misfit(known.assessment.edges["cam"], after) < chi2_limit(FALSE_ALARM, 6)
