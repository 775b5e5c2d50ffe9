"""What a task needs: the chance that picks land within it, and the verdict about that."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.cells import calibrated, reporting, showing
from support.marks import slow
from support.sound_findings import SOUND, changed, directions

from visioncal.calibration.pipeline.judging import findings_of
from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.need import Picks, need_met
from visioncal.calibration.suspects.judge import judge
from visioncal.calibration.suspects.judged import PointAccuracy
from visioncal.core.finding_kinds import GOOD_FOR, REPEATED_READINGS
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import exp, invert
from visioncal.core.types import Need
from visioncal.core.verdict import Finding, Remedy, remarks
from visioncal.estimation.arm import ArmErrors, misfit_jacobian, pose_basis
from visioncal.estimation.tolerance_probability import chance_within, radius_within
from visioncal.present.report.content import need_facts
from visioncal.results import Calibration, Rms, to_document
from visioncal.simulation import CellOptions, simulate


@pytest.mark.parametrize("freedom", [np.inf, 15.0])
@pytest.mark.parametrize("places", [1, 7])
@pytest.mark.parametrize("flat", [1.0, 0.03])
def test_the_chance_is_that_of_drawn_errors(freedom: float, places: int, flat: float) -> None:
    rng, count = np.random.default_rng(places), 200_000
    sizes = 1e-3 * np.geomspace(flat, 1.0, 6)[rng.permutation(6)]
    roots = sizes[:, None] * rng.standard_normal((places, 6, 6))
    spreads = roots @ np.swapaxes(roots, 1, 2)
    away = np.einsum(
        "nij,nj->ni", roots[np.arange(count) % places], rng.standard_normal((count, 6))
    )
    if np.isfinite(freedom):
        away /= np.sqrt(rng.chisquare(freedom, count) / freedom)[:, None]
    turned, shifted = (np.linalg.norm(value, axis=1) for value in (away[:, :3], away[:, 3:]))
    # 4,096 even points leave 0.007 at most, as 200,000 drawn ones leave three times 0.001.
    for share in (0.3, 0.7, 0.95):
        turn, shift = np.quantile(turned, share), np.quantile(shifted, share)
        both = np.mean((turned < turn) & (shifted < shift))
        assert chance_within(spreads, turn, shift, freedom) == pytest.approx(both, abs=0.01)
        assert chance_within(spreads, np.inf, shift, freedom) == pytest.approx(share, abs=0.01)
        assert chance_within(spreads, turn, np.inf, freedom) == pytest.approx(share, abs=0.01)
    radius = radius_within(spreads, 0.95, freedom)
    assert chance_within(spreads, np.inf, radius, freedom) == pytest.approx(0.95, abs=1e-6)


def test_round_errors_have_the_closed_form() -> None:
    covariance = 1e-8 * np.eye(6)[None]
    radius = 1e-4 * np.sqrt(chi2_limit(0.05, 3))
    assert radius_within(covariance, 0.95) == pytest.approx(radius, rel=2e-3)
    assert chance_within(covariance, np.inf, np.inf) == 1.0
    assert chance_within(np.zeros((1, 6, 6)), 1e-3, 1e-3) == 1.0
    assert radius_within(np.zeros((1, 6, 6)), 0.95) == 0.0


@pytest.mark.parametrize("mount", [slow("eye-in-hand"), "eye-to-hand"])
def test_picks_err_as_the_chain_does(mount: str) -> None:
    """Against errors that are drawn and put through the chain, by no slope of ours."""
    # Of this cell the images and the motion raise no doubt about the lens that is given.
    cell = simulate(CellOptions(mount=mount, views=12, seed=4 if mount == "eye-to-hand" else 0))
    known = without_arm_errors(calibrated(cell, joints=False))
    (picks,) = findings_of(known).picks
    rng, count = np.random.default_rng(0), 20_000
    result = known.assessment
    covariance = np.linalg.cholesky(result.covariance[:6, :6])
    views = rng.integers(len(known.used), size=count)
    problem = known.assessment.problem
    flange = known.robot_arm.poses[problem.observations.stops][views]
    middle = np.array([0.135, 0.09, 0.0, 1.0])
    seen = (problem.measured(result.state)[views] @ middle)[:, :, None]
    sigmas = np.repeat(result.noise.robots[0], 3)

    def noise():
        return exp(sigmas * rng.standard_normal((count, 6)))

    off = exp(rng.standard_normal((count, 6)) @ covariance.T)
    camera = result.state.edges[0]
    if mount == "eye-in-hand":
        away = flange @ (noise() @ camera @ off - camera) @ seen
    else:
        away = (camera @ off - camera) @ seen
    away = away[:, :3, 0] + sigmas[3:] * rng.standard_normal((count, 3))
    parts = {name: value for name, value in picks.budget_mm.items() if name != "left out"}
    total = np.sqrt(sum(part**2 for name, part in parts.items() if name != "total"))
    assert total == pytest.approx(1e3 * np.sqrt(np.mean(np.sum(away**2, axis=1))), rel=0.05)
    looks = {"look"} if mount == "eye-in-hand" else set()
    if not looks:
        # A focus that varies by what noise alone shows is next to nothing.
        assert parts.pop("look", 0.0) < 0.2 * parts["total"]
    assert set(parts) == {"board", "calibration", "pick", "total"} | looks


def without_arm_errors(known: RunState) -> RunState:
    """The same with an arm of which nothing but noise is known."""
    answer, solved = known.assessment, known.cell_fit
    arms = {name: replace(arm, errors=None) for name, arm in solved.arms.items()}
    covariance = answer.covariance - answer.covariance_by_source["arm"]
    changed = replace(answer, covariance=covariance)
    return replace(known, assessment_or_none=changed, cell_fit_or_none=replace(solved, arms=arms))


def test_an_arm_that_vibrates_now_and_then_does_so_at_picks() -> None:
    cell, rng = simulate(CellOptions(views=25)), np.random.default_rng(1)
    poses, away = cell.robot.base_from_flange.copy(), np.zeros((25, 6))
    # At four stops the flange is 0.6 mm off, which is twice as much as is needed.
    away[[3, 9, 14, 20], 3:] = 6e-4 * rng.permuted(np.eye(3)[[0, 1, 2, 0]], axis=1)
    sound, shaken = (
        calibrated(reporting(cell, base_from_flange=poses @ exp(errors)), joints=False)
        for errors in (0.0 * away, away)
    )
    assert sum(not view.used for view in shaken.assessment.views) == 4
    need = Need(mm=0.3)
    before, after = (known.findings.picks[0].probability(need) for known in (sound, shaken))
    # The look and the pick are eight of 21 + 8 chances, and the others stay as they were.
    assert after == pytest.approx(before * 21 / 29, abs=0.05)
    assert before > 0.95


def test_a_focus_that_changes_from_image_to_image_does_so_at_a_pick() -> None:
    """By 0.2 %, which shows a thing that much nearer or farther."""
    cell, rng, share = simulate(CellOptions()), np.random.default_rng(3), 2e-3
    centre = cell.options.camera.matrix[2:]
    zoomed = [
        replace(
            view_corners,
            px=centre + (1.0 + share * rng.standard_normal()) * (view_corners.px - centre),
        )
        for view_corners in cell.corners
    ]
    (picks,) = calibrated(showing(cell, zoomed), joints=False).findings.picks
    # Twenty views know a standard deviation to a sixth; three of that.
    assert picks.budget_mm["look"] == pytest.approx(1e3 * share * picks.distance_m, rel=0.5)


def test_what_an_arm_does_again_moves_no_pick() -> None:
    """Its base and its flange are off by 2 mm and 4 mrad: the frames have taken it up."""
    known = without_arm_errors(calibrated(simulate(CellOptions()), joints=False))
    answer, solved = known.assessment, known.cell_fit
    ((robot, arm),) = solved.arms.items()
    poses = answer.problem.poses[robot]
    fixed = pose_basis(poses)[:, :, :12]
    errors = ArmErrors(fixed, 4e-3, gain=0.0, of_links=False)
    off = errors.sigma * misfit_jacobian(answer.problem, answer.state, answer.noise, robot, errors)
    erring = replace(
        known,
        assessment_or_none=replace(answer, covariance=answer.covariance + off @ off.T),
        cell_fit_or_none=replace(solved, arms={robot: replace(arm, errors=errors)}),
    )
    (before,), (after,) = (findings_of(run_state).picks for run_state in (known, erring))
    # Both are the same to rounding, of spreads that would be a hundred times as large.
    np.testing.assert_allclose(
        after.covariances, before.covariances, atol=1e-3 * before.covariances.max()
    )


@pytest.mark.parametrize("mount", [slow("eye-in-hand"), "eye-to-hand"])
def test_errors_that_last_are_others_at_a_pick(mount: str) -> None:
    """Against drawn ones: those of the session move the fit, and a pick has its own."""
    known = without_arm_errors(calibrated(simulate(CellOptions(mount=mount)), joints=False))
    answer, solved = known.assessment, known.cell_fit
    ((robot, arm),) = solved.arms.items()
    poses, order = answer.problem.poses[robot], np.arange(len(answer.problem.poses[robot]))
    # An Ornstein-Uhlenbeck process of a memory of five stops, of 0.4 mrad and 0.2 mm.
    memory = np.linalg.cholesky(np.exp(-np.abs(order[:, None] - order) / 5.0))
    sizes = np.repeat([4e-4, 2e-4], 3)
    basis = (memory[:, None, :, None] * np.diag(sizes)[None, :, None]).reshape(len(poses), 6, -1)
    errors = ArmErrors(basis, 1.0, gain=0.0, of_links=False, time_correlated_count=basis.shape[2])
    off = misfit_jacobian(answer.problem, answer.state, answer.noise, robot, errors)
    erring = replace(
        known,
        assessment_or_none=replace(answer, covariance=answer.covariance + off @ off.T),
        cell_fit_or_none=replace(solved, arms={robot: replace(arm, errors=errors)}),
    )
    (before,), (after,) = (findings_of(run_state).picks for run_state in (known, erring))
    rng, count = np.random.default_rng(0), 20_000
    views = rng.integers(len(known.used), size=count)
    changing = basis - basis.mean(axis=0)

    def anew():
        drawn = rng.standard_normal((count, basis.shape[2]))
        return np.einsum("nip,np->ni", changing[views], drawn)

    stops, middle = answer.problem.observations.stops[views], np.array([0.135, 0.09, 0.0, 1.0])
    drawn = rng.standard_normal((count, basis.shape[2]))
    first, second = (exp(drawn @ off[at : at + 6].T) for at in (0, 6))
    camera, target = answer.state.edges[:2]
    if mount == "eye-in-hand":
        seen = answer.problem.measured(answer.state)[views] @ middle[:, None]
        away = poses[stops] @ (exp(anew()) @ camera @ first - camera) @ seen
        away = away[:, :3, 0] + anew()[:, 3:]
    else:
        there = poses[stops] @ target
        went = poses[stops] @ exp(anew()) @ target @ second
        lost = camera @ first @ invert(camera) @ there
        away = ((went - lost) @ middle)[:, :3]
    grown = after.budget_mm["total"] ** 2 - before.budget_mm["total"] ** 2
    # Twenty thousand draws know it to a hundredth; slopes at one place of a fit count for more.
    assert grown == pytest.approx(1e6 * np.mean(np.sum(away**2, axis=1)), rel=0.05)


def test_a_board_of_another_size_misplaces_things_for_a_calibrated_arm() -> None:
    """Its size is known to 0.1 %, and is off by 1.5 times that: the arm becomes as large."""
    size = 1.0015
    cell = simulate(CellOptions(dh_sigma_m=3e-4, dh_sigma_rad=3e-4, board_scale=size))
    known = calibrated(cell)
    assert all(arm.is_modelled for arm in known.cell_fit.arms.values())
    (picks,) = known.findings.picks
    middle, scaled = np.array([0.135, 0.09, 0.0, 1.0]), np.diag([size, size, size, 1.0])
    went = known.assessment.problem.predicted(known.assessment.state) @ middle
    seen = cell.cam_from_target[np.array(known.used)] @ scaled @ middle
    away_mm = 1e3 * np.sqrt(np.mean(np.sum((went - seen)[:, :3] ** 2, axis=1)))
    # 1.5 sigma of that size make nearly all of it, and what is held counts by its pull as well.
    assert 0.7 < away_mm / picks.budget_mm["total"] < 2.0
    # More views would not help, and are not the advice.
    needing = replace(known.findings, need=Need(0.15), corrects_targets=True)
    cause = judge(needing).causes[0]
    assert cause.kind == "unmeasured_board"
    assert "square_sigma_m" in cause.do.words


@pytest.mark.parametrize(("views", "is_found"), [(slice(1), False), (slice(1, None), True)])
def test_only_views_that_are_known_well_show_what_is_not_predicted(views: slice, is_found: bool):
    """A view of a small board from the front: off by 2 deg, which is 2.5 times its sigma."""
    known = calibrated(simulate(CellOptions(views=12)), joints=False)
    answer = known.assessment
    seen = answer.problem.observations
    among = seen.covariance.copy()
    among[0, :3, :3] = np.deg2rad(0.8) ** 2 / 3.0 * np.eye(3)
    away_rad = answer.held_out.residual_rad.copy()
    away_rad[views] = np.deg2rad(2.0)
    blurred = replace(answer.problem, observations=replace(seen, covariance=among))
    held = replace(answer.held_out, residual_rad=away_rad)
    findings = findings_of(
        replace(known, assessment_or_none=replace(answer, problem=blurred, held_out=held))
    )
    (picks,) = findings.picks
    kinds = [finding.kind for finding in judge(findings).findings]
    assert (("left out" in picks.parts), ("unexplained" in kinds)) == (is_found, is_found)


def of_size(sigma_mm: float, camera: str = "cam", robot: str = "robot") -> Picks:
    """Picks that err alike along all axes."""
    covariance = np.diag(np.repeat([1e-4, 1e-3 * sigma_mm], 3) ** 2)[None]
    return Picks(camera, robot, {"calibration": covariance}, np.inf, 0.5)


NEED = Need(0.5)


@pytest.mark.parametrize(
    ("sigma_mm", "status"), [(0.1, "good"), (0.17, "good"), (0.2, "check"), (0.4, "bad")]
)
def test_the_verdict_is_about_the_need(sigma_mm: float, status: str) -> None:
    verdict = judge(replace(SOUND, need=NEED, picks=(of_size(sigma_mm),)))
    assert verdict.status == status
    assert "where the views looked lands within 0.5 mm with a probability of" in verdict.reasons[0]
    assert verdict.good_for_mm == pytest.approx(sigma_mm * np.sqrt(7.815), rel=5e-3)
    causes = [] if status == "good" else ["calibration"]
    assert [cause.kind for cause in verdict.causes] == causes


@pytest.mark.parametrize(("sigma_mm", "status"), [(0.2, "good"), (0.7, "check")])
def test_what_a_camera_sees_counts_where_its_frame_is_known_less_well(sigma_mm, status) -> None:
    place = PointAccuracy("Where the views look, a point", {"intrinsics": 1.7, "total": 1.7}, 3.0)
    verdict = judge(replace(SOUND, places=(place,), picks=(of_size(sigma_mm),)))
    assert verdict.status == status
    assert ("place" in {finding.kind for finding in verdict.findings}) == (status == "check")


def test_both_have_to_hold() -> None:
    sound = replace(SOUND, picks=(of_size(0.1),))
    assert judge(replace(sound, need=Need(0.5, 0.05))).status == "good"
    assert judge(replace(sound, need=Need(0.5, 0.005))).status == "bad"
    assert judge(replace(sound, need=Need(None, 0.05))).status == "good"


@pytest.mark.parametrize(
    ("changes", "good_from_mm"),
    [
        ({"held_out": Rms(30.0, 5.0), "rms": Rms(29.0, 4.8)}, 0.0),
        ({"worst": directions(4e-3, 0, 0, 0)}, 0.0),
        ({"stops": 8}, 0.0),
        ({"noise_mm": 1.0}, 10.0),
        ({"noise_deg": 0.1}, 10.0),
        ({"held_out": Rms(3.0, 0.1), "noise_mm": 1.0}, 10.0),
        ({"warnings": remarks(["It is upside down."])}, np.inf),
        ({"pixel_px": 4.0}, np.inf),
    ],
)
def test_limits_give_way_to_the_need_and_what_is_unexplained_does_not(changes, good_from_mm):
    found = replace(changed(SOUND, **changes), picks=(of_size(0.1),))
    plain = judge(found)
    assert plain.status != "good"
    if np.isinf(good_from_mm):
        assert plain.good_for_mm is None
        assert judge(replace(found, need=Need(1e3))).status == "check"
        return
    assert plain.good_for_mm == pytest.approx(max(good_from_mm, 0.28), rel=0.01)
    assert f"good for tasks of {good_from_mm:g}" in plain.reasons[-1] or not good_from_mm
    assert judge(replace(found, need=Need(plain.good_for_mm))).status == "good"
    assert judge(replace(found, need=Need(0.9 * plain.good_for_mm))).status == "check"


@pytest.mark.parametrize("sigma_mm", [0.1, 0.101, 0.102, 0.104])
def test_a_result_is_good_for_the_need_that_it_prints(sigma_mm: float) -> None:
    found = replace(SOUND, picks=(of_size(sigma_mm),))
    plain = judge(found)
    (words,) = (finding.words for finding in plain.findings if finding.kind == GOOD_FOR)
    (fact,) = need_facts(None, plain)
    for shown in (words.partition("tasks of ")[2], fact.value):
        assert judge(replace(found, need=Need(float(shown.split()[0])))).status == "good"


@pytest.mark.parametrize("need", [None, NEED])
def test_repeated_readings_are_a_hint_and_no_doubt(need) -> None:
    empty = Finding(REPEATED_READINGS, "A place was read twice.", Remedy("Read others."))
    verdict = judge(replace(SOUND, warnings=(empty,), picks=(of_size(0.1),), need=need))
    assert verdict.status == "good"
    assert verdict.good_for_mm == pytest.approx(0.28, rel=0.01)
    assert not verdict.causes
    assert empty.do in verdict.next_steps


def test_the_worst_pair_counts_and_is_named() -> None:
    picks = (of_size(0.1, "cam_left", "a"), of_size(0.3, "cam_right", "b"))
    verdict = judge(replace(SOUND, need=NEED, picks=picks))
    assert "A pick by robot b of what cam_right sees where" in verdict.reasons[0]
    met = need_met(NEED, picks, whole=True)
    assert [pair.camera for pair in met.pairs] == ["left", "right"]
    assert met.probability == min(pair.probability for pair in met.pairs)
    assert met.of("left", "a").probability == met.pairs[0].probability
    assert need_met(None, picks) is None


def test_a_result_tells_what_it_is_good_for() -> None:
    known = calibrated(simulate(CellOptions(views=12)))
    plain = result_of(known)
    assert plain.need is None
    assert plain.verdict.good_for_mm == pytest.approx(0.2, abs=0.1)
    need = {"mm": plain.verdict.good_for_mm, "at": [0.5, 0.1, 0.0]}
    session = replace(known.session, document={**known.session.document, "need": need})
    asked = result_of(calibrated(simulate(CellOptions(views=12)), session=session))
    # The camera looks at a declared place as it looked at the board.
    assert asked.need.probability == pytest.approx(0.95, abs=1e-3)
    again = Calibration.from_json(json.dumps(to_document(asked)), "again")
    assert (again.need, again.verdict) == (asked.need, asked.verdict)
