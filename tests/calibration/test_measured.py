"""Measured components of an edge, for motion that leaves it open as a SCARA's does."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import calibrated, error_of, known_of
from support.marks import slow

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES, calibrate
from visioncal.calibration.stages.cell import read_cell
from visioncal.core.errors import DegenerateError
from visioncal.core.transforms import compose, exp, invert, log
from visioncal.live.planning.information import predict_worlds
from visioncal.live.planning.purposes import PURPOSES
from visioncal.live.planning.recorded import PartialCalibration, start_from_session
from visioncal.results import Calibration
from visioncal.session import MemoryImages, Session
from visioncal.simulation import CellOptions, Second, SimulatedCell, simulate
from visioncal.simulation.records import cell_session

SIGMA_M = 5e-4
X = exp(np.array([0.02, -0.03, 0.4, 0.06, -0.02, 0.081]))
Z = compose(np.diag([1.0, -1.0, -1.0]), np.array([0.4, 0.1, -0.25]))
# Of the target's poses, as a camera measures them [rad and m].
NOISE = np.repeat([2e-4, 1e-4], 3)
POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


PRIOR = {"z_m": float(X[2, 3]), "sigma_m": SIGMA_M}


def scara(seed: int, prior: dict[str, dict[str, float]], views: int = 12) -> Session:
    """A session of four axes: the tool turns about z alone, and exactly so."""
    rng = np.random.default_rng(seed)
    rows = []
    for view in range(views):
        turn = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-2.5, 2.5)]).as_matrix()
        flange = compose(turn, np.array([0.4, 0.1, 0.1]) + rng.uniform(-0.1, 0.1, 3))
        seen = invert(flange @ X) @ Z @ exp(NOISE * rng.standard_normal(6))
        numbers = [
            [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()] for pose in (flange, seen)
        ]
        rows.append([str(view), *(repr(float(value)) for value in np.concatenate(numbers))])
    document = {"schema": 1, "name": "scara", "mount": "eye-in-hand", "prior": prior}
    columns = ["view", *POSE, *(f"cft_{name}" for name in POSE)]
    return Session.assemble(document, columns, rows, MemoryImages({}))


def away(found: Calibration) -> np.ndarray:
    """(6,) right perturbation from the true `flange_from_cam` to the one that was found."""
    return log(invert(X) @ found.transforms["flange_from_cam"].as_matrix())


def run(cell: SimulatedCell, prior: dict[str, dict[str, float]]) -> RunState:
    """Calibrates a cell whose session knows something beforehand."""
    known = known_of(cell, level="hand-eye")
    document = {**known.session.document, "prior": prior}
    known = replace(known, session=replace(known.session, document=document))
    for stage in STAGES:
        if stage.name not in ("robot", "detect"):
            known = stage.run(known)
    return known


def test_the_one_camera_and_robot_may_have_names():
    plain = calibrate(scara(0, {"flange_from_cam": PRIOR}))
    session = scara(0, {"flange_a_from_cam_hand": PRIOR})
    named = {"cameras": {"hand": {}}, "robots": {"a": {}}}
    rows = [
        [*(view.cell(column) for column in session.columns), "a", "hand"] for view in session.views
    ]
    columns = [*session.columns, "robot", "camera"]
    found = calibrate(Session.assemble(session.document | named, columns, rows, MemoryImages({})))
    edge = next(iter(found.edges))
    assert found.edges[edge].matrix == pytest.approx(plain.edges["flange_from_cam"].matrix)


def test_four_axes_give_a_result_with_a_measured_height_and_none_without():
    with pytest.raises(DegenerateError, match="the tool's z is not determined at all") as refused:
        calibrate(scara(0, {}))
    assert "measure that offset for [prior.flange_from_cam]" in refused.value.next_step
    squares = []
    for seed in range(2):
        wrong = SIGMA_M * np.random.default_rng(100 + seed).standard_normal()
        prior = {"z_m": float(X[2, 3] + wrong), "sigma_m": SIGMA_M}
        found = calibrate(scara(seed, {"flange_from_cam": prior}))
        assert found.verdict.status == "good"
        assert any(
            reason.startswith(
                f"The measured z_m of flange_from_cam = {1e3 * prior['z_m']:g} mm was"
            )
            and reason.endswith("the views alone leave it open.")
            for reason in found.verdict.reasons
        )
        covariance, off = found.covariance("flange_from_cam"), away(found)
        # What was measured is all that is known of the height.
        height = X[2, :3] @ covariance[3:, 3:] @ X[2, :3]
        assert np.sqrt(height) == pytest.approx(SIGMA_M, rel=0.05)
        squares.append(off @ np.linalg.solve(covariance, off))
    # Chi-square of twelve, which chance leaves in one of a thousand cases on either side; the noise
    # is itself estimated from each session, to a tenth.
    assert 1.8 < np.sum(squares) < 40.0


def test_a_board_of_several_may_be_known_whole():
    options = CellOptions(robot="ur5e", motion="one_axis", views=12, second=Second(), seed=2)
    cell = simulate(options)
    name = "base_from_target_second"
    edge = cell.transforms[name]
    turn = Rotation.from_matrix(edge[:3, :3]).as_quat().tolist()
    prior = dict(zip(("x_m", "y_m", "z_m"), edge[:3, 3].tolist(), strict=True))
    prior |= {"sigma_m": SIGMA_M, "quaternion_xyzw": turn, "sigma_rad": 1e-5}
    known = run(cell, {name: prior})
    sigmas = np.sqrt(np.diag(known.assessment.covariance)[:18])
    # Four sigma, for eighteen numbers.
    assert np.all(np.abs(error_of(cell, known)) < 4.0 * sigmas)
    # The board is turned no farther than that is known.
    assert sigmas[12:15].max() < 1.001e-5
    assert sum("was used" in note and name in note for note in known.notes) == 3


@pytest.mark.slow
def test_a_measurement_that_good_data_contradict_is_told_and_left_out():
    cell = simulate(CellOptions(robot="ur5e", views=20, seed=3))
    true = float(cell.transforms["flange_from_cam"][2, 3])
    free = calibrated(cell, level="hand-eye")
    wrong = run(cell, {"flange_from_cam": {"z_m": true + 0.005, "sigma_m": SIGMA_M}})
    (told,) = (warning.words for warning in wrong.warnings if warning.kind == "prior")
    assert "is contradicted by the views" in told
    assert f"{1e3 * true + 5.0:g} mm" in told
    assert told.endswith("it is not used.")
    assert [cause.kind for cause in wrong.verdict.causes] == ["prior"]
    # It is said before that the views are few.
    few = simulate(CellOptions(robot="ur5e", views=6, seed=5))
    z_m = float(few.transforms["flange_from_cam"][2, 3]) + 0.02
    ranked = run(few, {"flange_from_cam": {"z_m": z_m, "sigma_m": 1e-3}}).verdict.ranked
    assert [finding.kind for finding in ranked[:2]] == ["prior", "few_stops"]
    # The same views once more, from where they were with it.
    sigmas = np.sqrt(np.diag(free.assessment.covariance))
    off = log(invert(free.assessment.state.edges) @ wrong.assessment.state.edges).ravel()
    # Sizes of noise and of the lens's field were sought beside it: these are known to a tenth.
    assert np.max(np.abs(off) / sigmas[: len(off)]) < 0.2
    assert wrong.used == free.used
    right = run(cell, {"flange_from_cam": {"z_m": true + 2e-4, "sigma_m": SIGMA_M}})
    assert not any(warning.kind == "prior" for warning in right.warnings)
    (note,) = (note for note in right.notes if "was used" in note)
    assert "the views alone determine it to" in note


# Ten sigma, and so many that noise beside the priors would explain them.
@pytest.mark.parametrize("off_m", [slow(0.005), 0.04])
def test_only_the_components_that_views_contradict_are_left_out(off_m):
    height = float(X[2, 3])
    prior = {"x_m": float(X[0, 3]) + off_m, "y_m": float(X[1, 3]) - off_m, "z_m": height}
    found = calibrate(scara(0, {"flange_from_cam": prior | {"sigma_m": SIGMA_M}}))
    assert found.verdict.status == "check"
    doubts = [finding.words for finding in found.verdict.findings if finding.kind == "prior"]
    for doubt, axis in zip(doubts, "xy", strict=True):
        stated_mm = 1e3 * prior[f"{axis}_m"]
        assert f"{axis}_m of flange_from_cam = {stated_mm:g} mm, known to 0.5 mm, is" in doubt
        seen_mm = float(doubt.partition("alone say ")[2].split()[0])
        # Some ten of their sigmas, and a fifth of the smaller of both offsets.
        assert seen_mm == pytest.approx(1e3 * X["xy".index(axis), 3], abs=1.0)
    kept = f"The measured z_m of flange_from_cam = {1e3 * height:g} mm was used"
    assert any(reason.startswith(kept) for reason in found.verdict.reasons)
    off, covariance = away(found), found.covariance("flange_from_cam")
    # Chi-square of 6 beyond 22 is 0.1 %.
    assert off @ np.linalg.solve(covariance, off) < 22.0


def test_what_cannot_be_used_is_said():
    prior = {"z_m": 0.1, "sigma_m": SIGMA_M}
    cell = simulate(CellOptions(robot="ur5e", views=12, seed=1))
    session = known_of(cell).session
    document = {**session.document, "prior": {"base_from_cam": prior}}
    elsewhere = known_of(cell, session=replace(session, document=document))
    assert read_cell(elsewhere).priors == ()
    other = calibrate(scara_with_tilt({"base_from_cam": prior}))
    assert any(
        "[prior.base_from_cam] was not used: what is unknown of this session is flange_from_cam "
        "and base_from_target" in reason
        for reason in other.verdict.reasons
    )
    (unused,) = (cause for cause in other.verdict.causes if cause.kind == "unused")
    assert unused.do.words.endswith("or delete [prior.base_from_cam] from session.toml.")
    closed = calibrate(scara_with_tilt({"flange_from_cam": prior}), solver="park")
    assert any(
        "was not used: the closed form park cannot" in reason for reason in closed.verdict.reasons
    )


def scara_with_tilt(prior: dict[str, dict[str, float]]) -> Session:
    """The same session, its first views tilted about other axes."""
    session = scara(5, prior, views=14)
    rows = [[view.cell(column) for column in session.columns] for view in session.views]
    rng = np.random.default_rng(6)
    for row in rows[:8]:
        flange = compose(
            Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix(),
            np.array([float(name) for name in row[1:4]]),
        )
        seen = invert(flange @ X) @ Z @ exp(NOISE * rng.standard_normal(6))
        numbers = [
            [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()] for pose in (flange, seen)
        ]
        row[1:] = [repr(float(value)) for value in np.concatenate(numbers)]
    return Session.assemble(session.document, session.columns, rows, MemoryImages({}))


def test_a_plan_counts_what_was_measured():
    cell = simulate(CellOptions(robot="ur5e", motion="one_axis", views=8, seed=4))
    place = cell.transforms["flange_from_cam"][:3, 3].tolist()
    prior = dict(zip(("x_m", "y_m", "z_m"), place, strict=True)) | {"sigma_m": SIGMA_M}
    begun = start_from_session(PartialCalibration(run(cell, {"flange_from_cam": prior})))
    (world,) = predict_worlds(
        [begun.cell], PURPOSES["hand-eye"], cell.robot.joints[:1], recorded=begun.recorded
    )
    covariance = world.covariance(np.arange(0))
    # Without a further stop: the three lengths are known to what they were measured to, or better.
    assert np.sqrt(np.diag(covariance)[3:6]).max() < 1.05 * SIGMA_M


@pytest.mark.parametrize(("scale", "mount"), [(1.0, "eye-in-hand"), (1.01, "eye-to-hand")])
def test_measured_distances_of_another_scale_are_named(mount, scale):
    cell = simulate(CellOptions(mount=mount, views=16, board_scale=scale, seed=2))
    verdict = calibrate(cell_session(cell, "measured", seen="poses")).verdict
    named = [finding for finding in verdict.findings if finding.kind == "board_size"]
    if scale == 1.0:
        assert verdict.status == "good"
        assert not named
        return
    assert verdict.status != "good"
    assert verdict.causes[0] is named[0]
    # A scale's sigma is a hundredth of a percent there; the factor has five digits.
    factor = float(named[0].do.words.split()[-1].rstrip("."))
    assert factor == pytest.approx(scale, abs=4e-4)


@pytest.mark.parametrize("seed", [0, slow(1), slow(2), slow(3)])
def test_an_arm_that_is_off_is_no_board_of_another_size(seed):
    arm = CellOptions(views=10, dh_sigma_m=2e-3, seed=seed)
    verdict = calibrate(cell_session(simulate(arm), "measured", seen="poses")).verdict
    assert "board_size" not in {finding.kind for finding in verdict.findings}
