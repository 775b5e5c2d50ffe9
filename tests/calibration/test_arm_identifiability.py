"""Identifiability of an arm at its stops: ranks, null space in words, indices, sigmas."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.cells import arm_found, calibrated
from support.edges import solved
from support.wrong_arms import WRONG_LINKS

from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.run import STAGES
from visioncal.calibration.stages.arm_report import add_parameters
from visioncal.core.choices import CONVENTIONS
from visioncal.core.transforms import exp, invert
from visioncal.core.types import MOUNTS
from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.armpair import ArmData
from visioncal.estimation.chain import chain, robot_part
from visioncal.estimation.identifiability import observability_indices
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.parameters import free_parameters, parameter_moves
from visioncal.estimation.problem_parts import ROBOT, Effect, Noise, State
from visioncal.estimation.solve import (
    Solution,
    covariance_of,
)
from visioncal.estimation.workspace import postures
from visioncal.results import to_document
from visioncal.results.arm import ArmLevel, ArmResult
from visioncal.robot import Loads, Robot, convert_table, load_robot, table_of
from visioncal.robot.jacobians import table_jacobian
from visioncal.robot.tables import table_from_document
from visioncal.simulation import simulate

ERROR_RAD = 1e-3
# What a camera of 5 MP makes of a board at half a metre, and an arm that repeats well.
CAMERA_SIGMAS = np.repeat([5e-5, 3e-5], 3)
NOISE = Noise.of_robot(5e-5, 3e-5)
SIZES = {"links": 6, "offsets": 1, "eccentricity": 2}
X = exp(np.array([0.3, 0.2, -0.4, 0.05, 0.02, 0.1]))
Z = exp(np.array([2.9, 0.2, -0.4, 0.5, 0.2, 0.1]))
TOOL = exp(np.array([0.1, 0.0, 0.2, 0.01, 0.02, 0.1]))


def erring(robot, blocks=("links",)):
    """An arm with errors of some blocks to be estimated, and a tool on its flange."""
    sizes = sum(SIZES[index] for index in blocks) * robot.joint_count
    return ArmModel(robot, TOOL, dict.fromkeys(blocks, 1.0), np.zeros(sizes))


def problem_of(model, mount, q, flange=None, noise=None):
    """What is seen at stops with joint angles q, the flange being elsewhere, up to some noise."""
    poses = model.robot.base_from_flange(q)
    seen = invert(robot_part(poses if flange is None else flange, mount) @ X) @ Z
    errors = ArmErrors(model.basis(q), ERROR_RAD, 0.0, of_links=True)
    covariance = np.tile(np.diag(CAMERA_SIGMAS**2), (len(q), 1, 1))
    effect = replace(errors.effect(ROBOT, values=model.values), values=np.zeros(len(model.values)))
    return chain(
        mount, poses, seen if noise is None else seen @ noise, covariance, effects=[effect]
    )


def arm_data(robot, q, mount="eye-in-hand", blocks=("links",)):
    """What is seen of an arm that is as stated."""
    model = erring(robot, blocks)
    problem = problem_of(model, mount, q)
    state = State(np.stack([X, Z]), np.zeros(len(model.values)))
    covariance = covariance_of(problem, Solution(state, NOISE))
    return ArmData(
        problem,
        state,
        NOISE,
        covariance,
        ROBOT,
        model,
        np.arange(12, len(covariance)),
        ERROR_RAD,
        np.arange(len(q)),
        q,
        Loads.none(len(q)),
        np.zeros(3),
        np.arange(12),
        np.ones(6, dtype=bool),
    )


def identified(data, convention=None):
    """The arm's section with its parameters, and which stops to add."""
    level = ArmLevel(level="nominal", unknowns=0, rms_mm=0.0, held_out_mm=0.0, likelihood_ratio=0.0)
    result = ArmResult(level="nominal", levels=(level,))
    return add_parameters(result, data, convention)


# Three axes and a wrist, with rails among them.
CRANE = {
    "schema": 1,
    "name": "crane",
    "convention": "standard",
    "joint": [
        {"type": "prismatic", "a_m": 0.1, "alpha_rad": -1.2, "d_m": 0.5},
        {"a_m": 0.4, "alpha_rad": 0.7, "d_m": 0.1},
        {"type": "prismatic", "a_m": 0.2, "alpha_rad": 1.3, "d_m": 0.3},
        {"a_m": 0.1, "alpha_rad": -1.1, "d_m": 0.2},
        {"a_m": 0.05, "alpha_rad": 1.4, "d_m": 0.1},
        {"a_m": 0.0, "alpha_rad": 0.0, "d_m": 0.1},
    ],
}
for row in CRANE["joint"]:
    if "type" in row:
        row |= {"lower_m": -0.4, "upper_m": 0.4}


# Parallel axes, none of them, seven joints, and rails.
ARMS = ("ur5e", "irb120", "panda", "crane")


def robot_of(name):
    return Robot.from_document(CRANE) if name == "crane" else load_robot(name)


def wrong(robot, rng):
    """An arm whose every link, and every revolute joint's function, is off by a milliradian."""
    functions = 1e-3 * rng.normal(size=(robot.joint_count, 4)) * [1.0, 0.0, 1.0, 1.0]
    functions[robot.chain.prismatic, 2:] = 0.0
    return robot.corrected(1e-3 * rng.normal(size=(robot.joint_count + 1, 6)), functions)


def rows_of(table):
    """(n, 5) theta, d, a, alpha and beta of each Z_i X_i."""
    n = len(table)
    names = ("theta_rad", "d_m", "a_m", "alpha_rad", "beta_rad")
    return np.stack([getattr(table, name)[-n:] for name in names], axis=1)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("name", ARMS)
def test_a_table_moves_as_its_derivatives_say(name, convention):
    robot, rng = robot_of(name), np.random.default_rng(0)
    like = convert_table(table_from_document(robot.document), convention)
    arm = wrong(robot, rng)
    table = table_of(arm, convention, like=like)
    twists = rng.normal(size=(3, len(table) + 1, 6))
    functions = rng.normal(size=(3, len(table), 4)) * [1.0, 0.0, 0.0, 0.0]
    # Common normals of nearly parallel axes run away with the inverse square of the angle.
    step = 1e-7 if convention == "hayati" else 1e-9
    for by, turn, way in zip(
        table_jacobian(arm, table, twists, functions), twists, functions, strict=True
    ):
        ends = [
            rows_of(table_of(arm.corrected(value * turn, value * way), convention, like=like))
            for value in (step, -step)
        ]
        # Base and flange are tilted by some mrad, whose product with a step is left out.
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(by, rel=0.01, abs=0.01)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("name", ARMS)
def test_ranks_are_those_of_theory(name, mount):
    """Everett and Hsu (1988): 4 a revolute joint, 2 a prismatic one, and 6 for the frames."""
    robot = robot_of(name)
    rails = int(robot.chain.prismatic.sum())
    turning = robot.joint_count - rails
    counts = identified(arm_data(robot, postures(robot)[:40], mount))[0].observability
    expected = 4 * turning + 2 * rails + 6
    assert counts.columns == 12 + 6 * robot.joint_count
    assert (counts.identifiable, counts.determined) == (expected, expected)


@pytest.mark.parametrize("name", ["ur5e", "irb120", "panda"])
def test_readings_of_one_point_tell_three_values_less(name):
    """A point of the tool has a place and no direction."""
    robot = load_robot(name)
    arm = arm_data(robot, postures(robot)[:60], "eye-to-hand")
    places = replace(arm.problem.observations, has_rotation=np.zeros(60, dtype=bool))
    problem = replace(arm.problem, observations=places)
    positions = replace(arm, problem=problem, measured=np.arange(6) > 2)
    whole, point = (
        identified(arm)[0].observability,
        identified(positions)[0].observability,
    )
    assert (point.identifiable, point.determined) == (whole.identifiable - 3, whole.determined - 3)


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_second_board_adds_six_values(mount):
    robot = load_robot("ur5e")
    arm = arm_data(robot, postures(robot)[:40], mount)
    seen = np.where(np.arange(40)[:, None, None] % 2 == 1, np.eye(6), 0.0)
    place = Effect.free("board", PriorInformation(np.zeros((6, 6)), np.zeros(6)), seen)
    problem = arm.problem.with_effects([place, *arm.problem.effects])
    state = replace(arm.state, values=problem.start_values)
    covariance = covariance_from(fisher_information(problem, state, arm.noise))
    further = {"frames": np.arange(18), "columns": 6 + arm.columns}
    both, _ = identified(
        replace(arm, problem=problem, state=state, covariance=covariance, **further)
    )
    counts = both.observability
    assert (counts.columns, counts.identifiable, counts.determined) == (54, 36, 36)
    # Half of the stops have a board of their own to place: they tell less of the arm.
    one, _ = identified(arm)
    assert both.workspace_sigma_mm.median > one.workspace_sigma_mm.median


@pytest.mark.parametrize("mount", MOUNTS)
def test_offsets_of_the_first_and_the_last_joint_are_never_told(mount):
    robot = load_robot("ur5e")
    numbers, advice = identified(arm_data(robot, postures(robot)[:40], mount, ("offsets",)))
    counts = numbers.observability
    assert (counts.identifiable, counts.determined) == (16, 16)
    assert numbers.not_determined == ()
    assert advice == ""
    # Both sines of each encoder are determined, however the arm is mounted.
    data = arm_data(robot, postures(robot)[:60], mount, ("links", "eccentricity"))
    both = identified(data)[0].observability
    assert (both.identifiable, both.determined) == (42, 42)


@pytest.mark.parametrize("name", ["ur3e", "ur5", "ur5e", "ur10", "ur10e", "ur16e"])
def test_beta_is_chosen_for_parallel_axes(name):
    robot = load_robot(name)
    data = arm_data(robot, postures(robot)[:40])
    by_default, standard = identified(data)[0], identified(data, "standard")[0]
    assert (by_default.convention, standard.convention) == ("hayati", "standard")
    betas = [value.joint for value in by_default.parameters if value.name == "beta_rad"]
    assert betas == ["shoulder_lift_joint", "elbow_joint"]
    # Four numbers a joint, six of which hide in the frames at both ends.
    assert len(by_default.parameters) == 24


def test_a_joint_that_hardly_moved_is_named():
    robot = load_robot("ur5e")
    q = postures(robot)[:40].copy()
    q[:, 4] = 1.2 + np.deg2rad(np.linspace(-1.0, 1.0, len(q)))
    numbers, advice = identified(arm_data(robot, q))
    counts = numbers.observability
    assert counts.identifiable == 30
    assert 26 <= counts.determined < 30
    assert len(numbers.not_determined) == 1
    assert numbers.not_determined[-1].startswith("these stops do not determine the ")
    assert f"determine {counts.determined} of the 30" in advice


def test_the_indices_are_as_published():
    found = observability_indices(np.array([8.0, 4.0, 2.0]), 4)
    wanted = {"condition": 4.0, "o1": 4.0 / 2.0, "o2": 0.25, "o3": 2.0, "o4": 0.5}
    assert found == pytest.approx(wanted | {"o5": 1.0 / (1 / 8 + 1 / 4 + 1 / 2)})


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_map_is_by_the_covariance(mount):
    robot = load_robot("ur5e")
    arm = arm_data(robot, postures(robot)[:15], mount)
    numbers, _ = identified(arm)
    anywhere = postures(arm.model.robot)
    flange, basis = arm.model.base_from_flange(anywhere), arm.model.basis(anywhere)
    poses, jacobian = arm.pair.jacobian(flange, basis)
    place = arm.pair.place_jacobian(poses, jacobian, arm.at)
    sigmas_m = np.sqrt(np.einsum("mij,jk,mik->m", place, arm.covariance, place))
    assert 1e-3 * numbers.map_sigmas_mm == pytest.approx(sigmas_m[: len(numbers.workspace_map)])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "convention"), [("ur5e", "hayati"), ("panda", "modified")])
def test_sigmas_hold_the_errors_of_the_numbers(name, convention):
    """Twenty arms drawn from what is known of them beforehand, and measured with noise."""
    robot = load_robot(name)
    rng, surprises = np.random.default_rng(3), []
    for _ in range(20):
        model = erring(robot)
        q = postures(robot, 200)[rng.permutation(60)[:25]]
        true = model.moved(ERROR_RAD * rng.normal(size=len(model.values)))
        noise = exp(rng.normal(size=(2, 25, 6)) * np.repeat(NOISE.robots[0], 3))
        flange = true.robot.base_from_flange(q) @ noise[0]
        result = solved(problem_of(model, "eye-in-hand", q, flange, noise[1]))
        found = model.moved(result.state.values)
        arm = replace(
            arm_data(robot, q),
            problem=problem_of(found, "eye-in-hand", q, flange, noise[1]),
            state=result.state,
            noise=result.noise,
            covariance=result.covariance,
            model=found,
        )
        numbers, _ = identified(arm, convention)
        like = convert_table(table_from_document(robot.document), convention)
        wanted = table_of(true.bare, convention, like=like)
        # What the frames hide keeps what was stated, which says nothing of the sigma.
        surprises += [
            (value.identified - parameter.value(wanted)) / value.sigma
            for parameter, value in zip(
                free_parameters(found, like), numbers.parameters, strict=True
            )
            if value.sigma < 0.4 * ERROR_RAD * parameter.unit
        ]
    assert len(surprises) > 20 * 14
    # Some four hundred squares, of which a few numbers of each arm hang together: 10 % each.
    assert np.mean(np.square(surprises)) == pytest.approx(1.0, abs=0.25)


def test_parameters_of_the_level_alone_are_told():
    model = erring(load_robot("ur5e"), ("offsets", "eccentricity"))
    table = convert_table(table_from_document(model.nominal.document), "hayati")
    kinds = {parameter.kind for parameter in free_parameters(model, table)}
    assert kinds == {"theta", "sine", "cosine"}
    moves = parameter_moves(model, table, [*free_parameters(model, table)])
    # Each value is one number of the table.
    assert np.abs(moves).sum(axis=0) == pytest.approx(np.ones(len(model.values)))


@pytest.fixture(scope="module")
def calibrated_cell():
    cell = simulate(replace(WRONG_LINKS, seed=7))
    return cell, calibrated(cell)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_the_result_is_in_the_convention_that_is_asked_for(calibrated_cell, convention):
    cell, known = calibrated_cell
    assert arm_found(known).sections.arm.convention == "hayati"
    asked = replace(known, convention=convention)
    (examine_again,) = (stage for stage in STAGES if stage.name == "examine")
    known = examine_again.run(asked)
    found = json.loads(json.dumps(to_document(result_of(known)), allow_nan=False))["kinematics"]
    assert found["convention"] == convention
    changes = {(value["joint"], value["name"]): value for value in found["parameters"]}
    assert (("elbow_joint", "beta_rad") in changes) == (convention == "hayati")
    # Across from the first axis to the second, which every convention tells to 0.1 mrad.
    row = "shoulder_lift_joint" if convention == "modified" else "shoulder_pan_joint"
    alpha = changes[row, "alpha_rad"]
    assert alpha["sigma"] < 1e-4
    assert alpha["identified"] == pytest.approx(
        cell.robot.true_arm.alpha[0], abs=4 * alpha["sigma"]
    )
    places = found["workspace_map"]
    assert 150 < len(places) <= 200
    assert all(0.0 < place["sigma_mm"] < 5.0 and place["z_m"] > 0.0 for place in places)
    counts = found["observability"]
    assert (counts["columns"], counts["identifiable"], counts["determined"]) == (48, 30, 30)
    assert counts["condition"] == pytest.approx(1.0 / counts["o2"])
