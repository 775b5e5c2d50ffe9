"""Tools and fixtures from touches: the answer and its sigma, what is refused, and the commands."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from support import placed as made
from support.commands import turned_poses, visioncal, write_poses, write_table
from support.misfits import misfit
from support.parts import placed, some_frame
from support.refusals import raised
from support.slopes import twists
from support.touched import TIP, Job, error_of, slipped, touched

from visioncal.calibration.run import run
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp, invert, skew
from visioncal.estimation.problem_parts import Noise
from visioncal.frames.fixture import drawn_fixture, touched_fixture
from visioncal.frames.points_frame import FitSettings
from visioncal.frames.touches import NominalPoints, Tool, TouchRows, touched_points
from visioncal.interchange.outputs import write_outputs
from visioncal.present.recording import read_calibration
from visioncal.results import Calibration, Edge, FrameFile, Verdict
from visioncal.robot import load_robot
from visioncal.session import Session
from visioncal.session.columns import POSE
from visioncal.simulation import CellOptions, simulate, write_session

TOOL_TIP = made.FLANGE_FROM_TOOL[:3, 3]
GOOD = Verdict("good")
# A tip that is known worst along the tool's z [m].
TIP_SIGMA = np.diag([5e-5, 5e-5, 4e-4])
FRAME = some_frame(np.random.default_rng(5))
NAMES = ("P1", "P2", "P3", "P4", "P5", "P6", "P7", "P8")
CAD_MM = np.array(
    [
        [0, 0, 0],
        [300, 0, 0],
        [300, 200, 0],
        [0, 200, 0],
        [150, 60, 40],
        [80, 20, 25],
        [250, 180, 25],
        [20, 150, 10],
    ]
)
FLAT_MM = np.array([[0, 0, 0], [300, 0, 0], [260, 200, 0], [0, 150, 0], [120, 40, 0]])
KINDS = ("origin", "x", "x", "xy", "xy", "origin", "xy")
ON_FEATURES = 1e-3 * np.array(
    [[0, 0, 0], [250, 0, 0], [300, 0, 0], [100, 200, 0], [200, 150, 0], [0, 0, 0], [-50, 180, 0]]
)
NOISE_M = 1e-4


def tool(sigma=None, verdict=GOOD):
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = np.zeros((3, 3)) if sigma is None else sigma @ sigma
    return Tool("flange_from_tool", Edge(made.FLANGE_FROM_TOOL, covariance), True, verdict)


def touch_rows(poses, kinds=None, points=None):
    blank = ("",) * len(poses)
    labels = tuple(str(index) for index in range(1, len(poses) + 1))
    places = tuple(f"touches.csv, line {index + 1}" for index in range(1, len(poses) + 1))
    return TouchRows("touches.csv", labels, places, poses, None, kinds or blank, points or blank)


def drawing(points_m, names=NAMES):
    return NominalPoints("cad.csv", names[: len(points_m)], points_m, np.zeros(len(points_m)))


def touching(points_m, rng, noise_m=0.0):
    """Poses that touch points (n, 3) of the fixture, each tilted its way."""
    met = placed(FRAME, points_m) + noise_m * rng.normal(size=points_m.shape)
    return turned_poses(rng, met, TOOL_TIP, FRAME[:3, :3])


def drawn(points_mm, names, *, seed=1, noise_m=NOISE_M, cad_mm=CAD_MM, cad_names=NAMES, **options):
    rng = np.random.default_rng(seed)
    poses = touching(1e-3 * np.asarray(points_mm, dtype=float), rng, noise_m)
    cad = drawing(1e-3 * np.asarray(cad_mm, dtype=float), cad_names)
    return touched_fixture(touch_rows(poses, points=tuple(names)), tool(), cad, **options)


def left_out_of(frame):
    return [observation.name for observation in frame.observations if not observation.used]


# --- The answer.


def test_exact_touches_give_the_exact_fixture():
    rng = np.random.default_rng(0)
    by_features = touched_fixture(touch_rows(touching(ON_FEATURES, rng), kinds=KINDS), tool())
    by_points = drawn(CAD_MM, NAMES, noise_m=0.0)
    for frame in (by_features, by_points):
        # Rounding of lengths near a metre, over levers of 0.1 m.
        assert np.abs(frame.edge.matrix - FRAME).max() < 1e-13
        assert frame.oriented
        assert frame.rms_mm < 1e-10
        assert frame.verdict.status == "good"
    assert by_points.details["scale"]["value"] == pytest.approx(1.0, abs=1e-12)
    assert by_features.method == "2 origin, 2 x, 3 xy touches"
    assert by_points.method == "best fit of 8 points to cad.csv"


def test_the_tips_error_is_a_pure_offset_where_all_touches_stand_alike():
    local = 1e-3 * CAD_MM
    met = placed(FRAME, local) + NOISE_M * np.random.default_rng(2).normal(size=local.shape)
    turn = Rotation.from_rotvec([3.0, 0.3, -0.2]).as_matrix()
    poses = compose(np.tile(turn, (len(met), 1, 1)), met - turn @ TOOL_TIP)
    rows, cad = touch_rows(poses, points=NAMES), drawing(local)
    exact, unsure = (touched_fixture(rows, tool(item), cad).edge for item in (None, TIP_SIGMA))
    assert np.array_equal(exact.matrix, unsure.matrix)
    more = unsure.covariance - exact.covariance
    turned = unsure.matrix[:3, :3].T @ turn @ made.FLANGE_FROM_TOOL[:3, :3] @ TIP_SIGMA
    # Of variances of 1e-7, through inverses of 1e8.
    assert np.abs(more[3:, 3:] - turned @ turned.T).max() < 1e-12
    assert np.abs(more[:3]).max() < 1e-12


def test_three_touches_say_what_their_sigma_rests_on():
    poses = touching(ON_FEATURES[[0, 1, 3]], np.random.default_rng(3))
    rows = touch_rows(poses, ("origin", "x", "xy"))
    assumed, stated = (touched_fixture(rows, tool(), touch_noise_m=item) for item in (None, 3e-4))
    assert assumed.verdict.status == "check"
    assert "0.1 mm, which is assumed" in assumed.verdict.reasons[0]
    assert "assumed" not in stated.verdict.reasons[0]
    assert assumed.noise_mm == pytest.approx(0.1)
    assert np.allclose(stated.edge.covariance, 9 * assumed.edge.covariance, rtol=1e-6)


@pytest.mark.slow
def test_few_touches_that_agree_by_chance_are_not_believed():
    chosen = [0, 1, 3, 4]
    kinds = tuple(KINDS[index] for index in chosen)
    squares = []
    for seed in range(100):
        poses = touching(ON_FEATURES[chosen], np.random.default_rng(seed), NOISE_M)
        frame = touched_fixture(touch_rows(poses, kinds), tool())
        squares.append(misfit(frame.edge, FRAME))
    # Chi-square of six stays under 41, five sigmas, in all but one case of a million.
    assert max(squares) < 41.0
    exact = touching(ON_FEATURES[chosen], np.random.default_rng(0))
    (reason,) = touched_fixture(touch_rows(exact, kinds), tool()).verdict.reasons
    assert "0.1 mm, which is assumed" in reason


# --- What is wrong is named.


def test_a_wrong_point_is_left_out_and_named():
    points = CAD_MM.astype(float)
    points[4] += [2.0, 0.0, 1.0]
    frame = drawn(points, NAMES)
    (reason,) = frame.verdict.reasons
    assert reason.startswith("Point P5 (touches.csv, line 6) was left out: 2.")
    assert frame.verdict.status == "check"
    assert left_out_of(frame) == ["P5"]
    # Of eight points with a noise of 0.1 mm, the others place it to 0.05 mm.
    assert np.abs(frame.edge.matrix - FRAME).max() < 5e-4


def test_two_exchanged_names_are_named():
    names = ("P1", "P2", "P7", *NAMES[3:6], "P3", "P8")
    frame = drawn(CAD_MM, names)
    words = " ".join(frame.verdict.reasons)
    assert words.count("or named as another") == 2
    (step,) = {finding.do.words for finding in frame.verdict.findings if finding.kind == "left_out"}
    assert step.startswith("Correct the names of what is named")
    assert sorted(left_out_of(frame)) == ["P3", "P7"]
    assert frame.verdict.reasons[0].startswith("Of P3 and P7, the names are exchanged: ")
    few = (0, 1, 4, 5)
    with pytest.raises(DataError, match="fixture: Of P5 and P6, the names are exchanged"):
        drawn(CAD_MM[[0, 1, 5, 4]], [NAMES[index] for index in few])
    # Of a rectangle's corners, exchanging either pair of neighbours gives the same shape.
    with pytest.raises(DataError, match="Of P1 and P2, or of P3 and P4, the names are exchanged"):
        drawn(CAD_MM[:4], ("P2", "P1", "P3", "P4"))


@pytest.mark.parametrize("count", [5, 6])
@pytest.mark.parametrize("change", [[1, -1, 1], [-1, 1, 1]])
def test_a_mirrored_drawing_is_bad(count, change):
    """Though most of its points lie in one plane, and agree."""
    frame = drawn(CAD_MM[:count], NAMES[:count], cad_mm=CAD_MM * change)
    assert frame.verdict.status == "bad"
    assert frame.verdict.reasons[0].startswith("cad.csv is a mirror image of the part")


@pytest.mark.slow
def test_no_mistake_of_names_is_found_where_there_is_none():
    for seed in range(20):
        frame = drawn(CAD_MM, NAMES, seed=seed, noise_m=1e-3)
        kinds = {finding.kind for finding in frame.verdict.findings}
        assert not kinds & {"exchanged_names", "mirrored"}


def test_a_point_that_was_touched_several_times_counts_as_one():
    frame = drawn(np.vstack([CAD_MM, CAD_MM[:4]]), NAMES + NAMES[:4])
    assert frame.method == "best fit of 12 touches of 8 points to cad.csv"
    assert [observation.name for observation in frame.observations[-2:]] == ["P3, 11", "P4, 12"]
    assert frame.observations[4].name == "P5"
    assert frame.verdict.status == "good"
    raised(DataError, "2 measured points", drawn, np.tile(CAD_MM[:2], (3, 1)), NAMES[:2] * 3)


def test_a_part_of_another_size_is_reported_and_not_absorbed():
    frame = drawn(1.002 * CAD_MM, NAMES)
    (reason,) = frame.verdict.reasons
    assert reason.startswith("The part is 1.00")
    assert "full scale" in reason
    scale = frame.details["scale"]
    assert abs(scale["value"] - 1.002) < 4 * scale["sigma"]
    warm = drawn(1.0005 * CAD_MM, NAMES, noise_m=1e-5)
    assert "warm" in warm.verdict.reasons[0]
    # Without the scale the middle is where it was: 0.2 % over 200 mm are 0.4 mm at the origin.
    centre = placed(frame.edge.matrix, np.mean(1e-3 * CAD_MM, axis=0)[None])
    meant = placed(FRAME, np.mean(1.002e-3 * CAD_MM, axis=0)[None])
    assert np.linalg.norm(centre - meant) < 2e-4


def test_a_part_of_another_size_precedes_what_follows_of_it():
    findings = drawn(1.004 * CAD_MM, NAMES).verdict.findings
    assert findings[0].kind == "scale"
    assert "--cad-unit" in findings[0].do.words


def test_another_tool_than_stated_is_found_by_the_touches():
    rng = np.random.default_rng(1)
    rows = touch_rows(touching(1e-3 * CAD_MM, rng, NOISE_M), points=tuple(NAMES))
    longer = made.FLANGE_FROM_TOOL @ compose(np.eye(3), np.array([0.0, 0.01, 0.05]))
    other = replace(tool(), name="flange_from_other", edge=Edge(longer, np.zeros((6, 6))))
    for stated, words in ((other, "with flange_from_other"), (None, "--tool none")):
        cad = drawing(1e-3 * CAD_MM)
        error = raised(DataError, "another tool touched", touched_fixture, rows, stated, cad)
        assert words in str(error)
        # Six points of 0.1 mm know it to some tenths.
        found = re.search(r"a tip at \(([-\d., ]*)\) mm", str(error))
        assert np.fromstring(found[1], sep=",") == pytest.approx(1e3 * TOOL_TIP, abs=0.5)


def test_a_plane_has_a_hand_by_the_side_that_it_was_touched_from():
    flat = {"cad_mm": FLAT_MM, "cad_names": NAMES[:5]}
    right = drawn(FLAT_MM, NAMES[:5], **flat)
    assert right.verdict.status == "good"
    assert right.details["coplanar"]
    (wrong,) = drawn(FLAT_MM * [1, -1, 1], NAMES[:5], **flat).verdict.reasons
    assert "a mirrored drawing looks like this" in wrong
    # The poses of the tip itself are known by their positions alone.
    poses = np.full((5, 4, 4), np.nan)
    poses[:, :3, 3] = placed(FRAME, 1e-3 * FLAT_MM) + NOISE_M * np.random.default_rng(1).normal(
        size=FLAT_MM.shape
    )
    cad = drawing(1e-3 * FLAT_MM)
    by_points = touched_fixture(touch_rows(poses, points=NAMES[:5]), None, cad)
    assert "a mirrored drawing would fit them as well" in by_points.verdict.reasons[0]


def test_few_noisy_or_uncertain_points_are_doubted():
    words = " ".join(drawn(CAD_MM[:3], NAMES[:3]).verdict.reasons)
    assert "Only 3 points are used" in words
    noisy = drawn(CAD_MM, NAMES, noise_m=1e-3)
    assert "mm only (per axis; doubt begins at 0.5)" in " ".join(noisy.verdict.reasons)
    stated = drawn(CAD_MM, NAMES, noise_m=3e-4, touch_noise_m=5e-5)
    assert "scatter by more than they are stated to" in " ".join(stated.verdict.reasons)
    rng = np.random.default_rng(1)
    rows = touch_rows(touching(1e-3 * CAD_MM, rng, NOISE_M), points=NAMES)
    unsure = touched_fixture(rows, tool(1e-3 * np.eye(3)), drawing(1e-3 * CAD_MM))
    assert "is known to 1 mm only" in " ".join(unsure.verdict.reasons)


@pytest.mark.parametrize(("tools", "fixtures"), [("check", "check"), ("bad", "bad")])
def test_a_tool_in_doubt_makes_its_fixture_doubtful(tools, fixtures):
    rows = touch_rows(touching(1e-3 * CAD_MM, np.random.default_rng(1), NOISE_M), points=NAMES)
    doubtful = tool(verdict=Verdict.of(tools, "The tip wobbles."))
    frame = touched_fixture(rows, doubtful, drawing(1e-3 * CAD_MM))
    assert frame.verdict.status == fixtures
    assert "flange_from_tool, is in doubt itself" in frame.verdict.reasons[0]
    assert "The tip wobbles." in frame.verdict.reasons[0]


@pytest.mark.slow
def test_errors_that_points_share_are_carried_to_the_answer():
    # As a camera's: another covariance than a tip's, for all points together.
    rng = np.random.default_rng(8)
    rows = touch_rows(touching(1e-3 * CAD_MM, rng), points=NAMES)
    measured = touched_points(rows, tool(), Noise.of_robot(0.0, 1e-6), None)
    # As if the whole set were turned about the base, and shifted.
    sigmas = np.array([1e-4, 2e-4, 3e-4, 1e-4, 1e-4, 5e-5])
    jacobian = np.concatenate(
        [sigmas * np.hstack([-skew(point), np.eye(3)]) for point in measured.points]
    )
    shared = replace(measured, common=jacobian @ jacobian.T)

    def fitted(points):
        return drawn_fixture(points, drawing(1e-3 * CAD_MM), FitSettings()).edge

    def moved(step):
        turned = replace(measured, points=placed(exp(sigmas * step), measured.points))
        return fitted(turned).matrix[None]

    by_sigma = twists(moved, 6, 1.0)[0]
    # What is each point's own is a hundredth of it: 1e-4 of the variance.
    expected = by_sigma @ by_sigma.T
    assert np.abs(fitted(shared).covariance - expected).max() < 1e-3 * np.abs(expected).max()


# --- The command.


@pytest.fixture
def tool_file(tmp_path):
    path = tmp_path / "frames.json"
    made.frame_file(made.tool()).save(path)
    return path


def cad_file(path, points=CAD_MM, names=NAMES, columns=("x_mm", "y_mm", "z_mm")):
    return write_table(path, columns, list(points), {"point": names})


def touches_file(path, points_mm=CAD_MM, names=NAMES, seed=1, scale=1.0):
    rng = np.random.default_rng(seed)
    poses = touching(1e-3 * np.asarray(points_mm, dtype=float), rng, NOISE_M)
    poses[:, :3, 3] *= scale
    return write_poses(path, poses, {"view": range(len(poses)), "point": names})


def fixture(folder, tool_file, *more, cad=True, **changes):
    touches = touches_file(folder / "touches.csv", **changes)
    drawn_at = ("--cad", cad_file(folder / "cad.csv")) if cad else ()
    return visioncal("fixture", touches, "--tool", tool_file, *drawn_at, *more)


MIRRORED = CAD_MM * [1, -1, 1]
LINE = np.outer(np.arange(8), [50, 0, 0])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"points_mm": MIRRORED}, "cad.csv is a mirror image of the part"),
        ({"points_mm": LINE[:6], "names": NAMES[:6]}, "the points do not fit the drawing"),
        ({"points_mm": CAD_MM[:2], "names": NAMES[:2]}, "takes at least 3"),
        ({"scale": 1000.0}, "these look like millimetres. "),
        ({"scale": 0.001}, "metres read as millimetres"),
        ({"names": NAMES[::-1]}, "The points have each other's names (P1 is P8, P2 is P7,"),
        ({"names": NAMES[1:] + NAMES[:1]}, "P8 is P7): corrected, all points agree to 0."),
        ({"names": ("p1", "P22", *NAMES[2:])}, "cad.csv has no point P22; it has P1, P2"),
        ({"names": ("", *NAMES[1:])}, "touches.csv, line 2: the touched point is not named"),
        ({"names": ("",) * 8}, "touches.csv: the touched point is not named"),
    ],
)
def test_a_contradicting_request_is_refused(tmp_path, tool_file, changes, words):
    fixture(tmp_path, tool_file, "-o", tmp_path / "new.json", **changes).refused(words)
    assert not (tmp_path / "new.json").exists()


def test_features_need_their_kinds(tmp_path, tool_file):
    poses = touching(ON_FEATURES, np.random.default_rng(1), NOISE_M)

    def run(kinds, *more):
        touches = write_poses(tmp_path / "touches.csv", poses[: len(kinds)], {"kind": kinds})
        return visioncal("fixture", touches, "--tool", tool_file, *more)

    run(KINDS).good()
    run(("",) * 7).refused("kind is missing, but must be one of origin, x, xy", "--cad")
    run(("orgin", *KINDS[1:])).refused("line 2: kind is 'orgin'", "Did you mean origin?")
    run(KINDS[:3]).refused("no touch of kind xy")
    other = {"origin": "origin", "x": "xy", "xy": "x"}
    run([other[kind] for kind in KINDS]).refused("(x is xy, xy is x) have each other's kinds: corr")
    of_two = [KINDS.index("x"), KINDS.index("xy")]
    kinds = list(KINDS)
    kinds[of_two[0]], kinds[of_two[1]] = "xy", "x"
    words = f"touches {of_two[0]} (xy) and {of_two[1]} (x) have each other's kinds: corrected"
    run(kinds).refused(words)
    on_a_line = 0.1 * np.outer([0.0, 1.0, 3.0], [1.0, 0.0, 0.0])
    poses = touching(on_a_line, np.random.default_rng(2), NOISE_M)
    run(("origin", "x", "xy")).refused(
        "the fixture's rotation about its x is not determined at all", "at a noise of 0.1 mm"
    )
    poses = touching(ON_FEATURES, np.random.default_rng(1), NOISE_M)
    run(KINDS, "--cad", cad_file(tmp_path / "cad.csv")).refused("Leave --cad away")


def test_units_of_the_drawing_are_read(tmp_path, tool_file):
    touches = touches_file(tmp_path / "touches.csv")

    def run(columns, *more):
        cad = cad_file(tmp_path / "cad.csv", columns=columns)
        return visioncal("fixture", touches, "--tool", tool_file, "--cad", cad, *more)

    run(("X_mm", "Y_mm", "Z_mm")).good()
    # Who says a unit has seen that the names are wrong.
    run(("x_m", "y_m", "z_m"), "--cad-unit", "mm").good()
    run(("x_m", "y_m", "z_m")).refused("times as large as drawn")
    run(("x", "y", "z")).refused("x, y, z are in no unit that is named")


def test_a_drawings_own_sigma_counts(tmp_path, tool_file):
    touches = touches_file(tmp_path / "touches.csv")
    sigmas = {"point": NAMES, "sigma_um": [50] * 7 + [5000]}
    cad = write_table(tmp_path / "cad.csv", ("x_mm", "y_mm", "z_mm"), list(CAD_MM), sigmas)
    # What is drawn to 5 mm says nothing against the others, wherever it is.
    text = cad.read_text().replace("20,150,10", "24,155,12")
    cad.write_text(text)
    done = visioncal("fixture", touches, "--tool", tool_file, "--cad", cad, "--json")
    found = json.loads(done.out)["base_from_fixture"]
    assert all(value["used"] for value in found["observations"])
    # Seven points of 0.1 mm with a tip of 0.2 mm; the eighth would turn them by 10 mrad.
    assert np.abs(np.array(found["matrix"]) - FRAME).max() < 2e-3
    cad.write_text(text.replace(",50,", ",-50,"))
    assert "the sigma is negative" in visioncal("fixture", touches, "--cad", cad, "--tool=none").err


def test_the_tool_that_touched_is_named_or_found(tmp_path, tool_file):
    cad, touches = cad_file(tmp_path / "cad.csv"), touches_file(tmp_path / "touches.csv")
    two = tmp_path / "two.json"
    made.frame_file({"flange_from_gripper": made.frame(made.FLANGE_FROM_TOOL), **made.tool()}).save(
        two
    )

    def run(*more):
        return visioncal("fixture", touches, "--cad", cad, *more)

    run("--tool", f"{two}:gripper").good()
    run("--tool", f"{tool_file}:flange_from_tool").good()
    run().refused("The tool that touched the points is not stated", "--tool none")
    run("--tool", two).refused("has 2 tools: flange_from_gripper, flange_from_tool")
    run("--tool", f"{two}:griper").refused("Did you mean flange_from_gripper")


def test_positions_of_the_tip_itself_are_enough(tmp_path, tool_file):
    rng = np.random.default_rng(2)
    met = placed(FRAME, 1e-3 * CAD_MM) + NOISE_M * rng.normal(size=CAD_MM.shape)
    cad, touches = cad_file(tmp_path / "cad.csv"), tmp_path / "touches.csv"

    def run(names, *more):
        write_table(touches, names, (1e3 * met).round(4).tolist(), {"point": NAMES})
        return visioncal("fixture", touches, "--cad", cad, "--json", *more)

    none = ("--tool", "none")
    for done in (
        run(("x_mm", "y_mm", "z_mm"), *none),
        run(("X", "Y", "Z"), *none, "--robot-form", "kuka"),
        run(("a", "b", "c"), *none, "--robot-columns", "a,b,c", "--robot-unit", "mm"),
    ):
        found = json.loads(done.out)["base_from_fixture"]
        # Eight points of 0.1 mm over 0.3 m.
        assert np.abs(np.array(found["matrix"]) - FRAME).max() < 5e-4
    run(("X", "Y", "Z"), *none).refused("are in no unit that is named")
    run(("x_m", "y_m", "z_m"), *none).refused("these look like millimetres")
    run(("x_mm", "y_mm", "z_mm"), "--tool", tool_file).refused("say --tool none")


# Ten touches, 45 degrees, 0.1 mm: the tip is known to some 0.05 mm per axis.
NEAR_MM = 0.3


def file_of(path, touches, **columns):
    more = {"view": range(1, len(touches) + 1), "kind": touches.kinds}
    if len(touches.names) > 1:
        more["point"] = [touches.names[index] for index in touches.points]
    return write_poses(path, touches.base_from_flange, more | columns)


def tcp(folder, touches, *more):
    return visioncal("tcp", file_of(folder / "touches.csv", touches), *more)


def _meeting(robot, rng):
    """Joint angles (8, 6) at which the tip is at one point, each another way."""
    home = np.array([0.4, -1.3, 1.5, -1.75, -1.57, 0.3])

    def tip(joints):
        return robot.base_from_flange(joints[None])[0, :3] @ np.append(TIP, 1.0)

    point = tip(home)
    starts = home + rng.uniform(-0.4, 0.4, (8, 6))
    return np.array([least_squares(lambda value: tip(value) - point, start).x for start in starts])


def found(done):
    assert done.status == 0, done.err
    return next(iter(json.loads(done.out).values()))


def off_mm(document):
    return 1e3 * np.linalg.norm(np.array(document["translation_m"]) - TIP)


# --- What it finds.


def test_a_frame_is_taken_out_again(tmp_path):
    file, touches = tmp_path / "frames.json", tmp_path / "touches.csv"
    touches.write_text(visioncal("tcp", "--example").out)
    for name in ("gripper", "probe"):
        assert visioncal("tcp", touches, "-o", file, "--name", name).status == 0
    visioncal("tcp", "-o", file, "--remove").refused("has no flange_from_tool", "probe")
    visioncal("tcp", touches, "-o", file, "--name", "probe", "--remove").refused("places nothing")
    done = visioncal("tcp", "-o", file, "--name", "probe", "--remove")
    assert "flange_from_probe is no longer in" in done.out
    assert [*FrameFile.load(file).frames] == ["flange_from_gripper"]
    visioncal("tcp", "--name", "gripper", "--remove").refused("Name where it is with -c or -o")


def test_five_real_touches_determine_a_tip(real_data):
    done = visioncal("tcp", real_data / "tcp_pivot_rvbust/poses.csv", "--json")
    tool = found(done)
    # Figures of a plain linear fit by others, as they round them.
    assert 1e3 * np.array(tool["translation_m"]) == pytest.approx([33.78, 0.97, 76.79], abs=0.006)
    assert tool["rms_mm"] == pytest.approx(0.219, abs=0.001)
    # Each axis is known to about 0.1 mm by five touches of 0.16 mm per axis.
    assert tool["sigma_mm"] == pytest.approx(0.18, abs=0.02)
    assert tool["verdict"]["status"] == "good"
    assert not tool["oriented"]


def test_the_tip_and_its_rotation_are_found(tmp_path):
    made = touched(Job(axes=3), 1)
    done = tcp(tmp_path, made.touches, "--json")
    tool = found(done)
    assert tool["oriented"]
    assert tool["verdict"]["status"] == "good"
    error = error_of(np.array(tool["matrix"]))
    # 0.1 mm over levers of 100 mm, with three touches of each kind.
    assert np.linalg.norm(error[:3]) < 4 * np.deg2rad(tool["sigma_deg"]) < np.deg2rad(0.5)
    assert 1e3 * np.linalg.norm(error[3:]) < NEAR_MM
    assert tool["method"] == (
        "pivot of 10 touches of one point; rotation from 3 along z and 3 in the xz plane"
    )
    assert {value["kind"] for value in tool["observations"]} == {"point", "z", "xz"}
    off = [value["residual_mm"] for value in tool["observations"] if value["used"]]
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(tool["rms_mm"])


def test_poses_of_a_tool_that_was_active_are_doubted(tmp_path):
    made = touched(Job(), 1)
    of_tip = made.touches.base_from_flange.copy()
    of_tip[:, :3, 3] += of_tip[:, :3, :3] @ TIP
    tool = found(tcp(tmp_path, replace(made.touches, base_from_flange=of_tip), "--json"))
    assert tool["verdict"]["status"] == "check"
    assert "active in the controller" in tool["verdict"]["reasons"][0]


def test_some_poses_of_a_tool_that_was_active_are_left_out(tmp_path):
    made = touched(Job(axes=2), 1)
    poses, rows = made.touches.base_from_flange.copy(), [1, 4, 6]
    poses[rows, :3, 3] += poses[rows, :3, :3] @ TIP
    tool = found(tcp(tmp_path, replace(made.touches, base_from_flange=poses), "--json"))
    assert off_mm(tool) < NEAR_MM
    assert [at["name"] for at in tool["observations"] if not at["used"]] == ["2", "5", "7"]
    assert "moment or tool" in tool["verdict"]["reasons"][0]


def test_touches_of_axes_hide_no_mistake_of_the_tips(tmp_path):
    made = touched(Job(axes=2), 1)
    inverse = replace(made.touches, base_from_flange=invert(made.touches.base_from_flange))
    tcp(tmp_path, inverse).refused("poses read the other way round", "--robot-inverse")
    # Every other touch with the tip is of a point of its own.
    poses = made.touches.base_from_flange.copy()
    poses[1 : made.touches.kinds.count("point") : 2, :3, 3] += [0.05, 0.03, 0.02]
    tcp(tmp_path, replace(made.touches, base_from_flange=poses)).refused(
        "agree on a point of their own", "column point"
    )


def test_a_touch_with_the_name_of_another_point_is_left_out(tmp_path):
    made = touched(Job(tips=4, points=2, axes=2), 2)
    points = made.touches.points.copy()
    points[2] = 1 - points[2]
    tool = found(tcp(tmp_path, replace(made.touches, points=points), "--json"))
    assert off_mm(tool) < NEAR_MM
    assert [at["name"] for at in tool["observations"] if not at["used"]] == ["3"]


def test_several_points_need_fewer_touches_of_each(tmp_path):
    tool = found(tcp(tmp_path, touched(Job(tips=4, points=3), 2).touches, "--json"))
    assert off_mm(tool) < NEAR_MM
    assert set(tool["details"]["points_m"]) == {"A", "B", "C"}


def test_poses_in_other_forms_are_read(tmp_path):
    poses = touched(Job(), 3).touches.base_from_flange
    turns = Rotation.from_matrix(poses[:, :3, :3])
    path, mm = tmp_path / "touches.csv", 1e3 * poses[:, :3, 3]
    kuka = np.hstack([mm, turns.as_euler("ZYX", degrees=True)])
    write_table(path, ("X", "Y", "Z", "A", "B", "C"), kuka.tolist())
    assert off_mm(found(visioncal("tcp", path, "--robot-form", "kuka", "--json"))) < NEAR_MM
    abb = np.hstack([mm, np.roll(turns.as_quat(), 1, axis=1)])
    write_table(path, ("x", "y", "z", "q1", "q2", "q3", "q4"), abb.tolist())
    assert off_mm(found(visioncal("tcp", path, "--robot-unit", "mm", "--json"))) < NEAR_MM
    back = invert(poses)
    write_poses(path, back)
    done = visioncal("tcp", path)
    assert "--robot-inverse" in done.out
    assert done.out.startswith("check")
    assert off_mm(found(visioncal("tcp", path, "--robot-inverse", "--json"))) < NEAR_MM


def test_joint_angles_go_through_the_robots_model(tmp_path):
    robot, rng = load_robot("ur10e"), np.random.default_rng(4)
    joints = _meeting(robot, rng)
    names = [f"q{index}_rad" for index in range(1, 7)]
    path = write_table(tmp_path / "touches.csv", names, joints.tolist())
    done = visioncal("tcp", path, "--robot-model", "ur10e", "--json")
    # Exact touches, but for the digits of the joints' angles.
    assert off_mm(found(done)) < 1e-3
    visioncal("tcp", path).refused("--robot-model")
    degrees = write_table(tmp_path / "deg.csv", names, np.rad2deg(joints).tolist())
    visioncal("tcp", degrees, "--robot-model", "ur10e").refused("--joint-unit deg")
    done = visioncal("tcp", degrees, "--robot-model", "ur10e", "--joint-unit", "deg", "--json")
    assert off_mm(found(done)) < 1e-3
    visioncal("tcp", path, "--robot-model", "panda").refused("6 joint angles, but")


def test_the_rows_of_a_session_are_touches(tmp_path):
    touches = touched(Job(), 12).touches
    head = 'schema = 1\nname = "touches"\nmount = "eye-in-hand"\n'
    (tmp_path / "session.toml").write_text(head)
    columns = {"view": range(20, 30), "point": ["A"] * 10}
    write_poses(tmp_path / "views.csv", touches.base_from_flange, columns)
    tool = found(visioncal("tcp", tmp_path, "--json"))
    assert off_mm(tool) < NEAR_MM
    assert [int(value["name"]) for value in tool["observations"]] == [*range(20, 30)]
    assert tool["source"] == "touches"


def test_tables_of_a_touch_each_are_touches(tmp_path):
    """As of a program that writes a file each time; of a session in there the folder is named."""
    poses, folder = touched(Job(), 12).touches.base_from_flange, tmp_path / "touches"
    folder.mkdir()
    for at, pose in enumerate(poses):
        turns = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
        row = [*(1e3 * pose[:3, 3]), *turns]
        write_table(folder / f"touch_{at}.csv", ("x_mm", "y_mm", "z_mm", "rx", "ry", "rz"), [row])
    tool = found(visioncal("tcp", folder, "--robot-form", "ur", "--json"))
    assert off_mm(tool) < NEAR_MM
    assert len(tool["observations"]) == len(poses)
    (folder / "cell").mkdir()
    (folder / "cell/session.toml").write_text("schema = 1")
    visioncal("tcp", folder).refused("Name the session's folder")


# --- What is wrong is named.


def test_one_wrong_touch_in_ten_is_named(tmp_path):
    made = touched(Job(), 5)
    wrong = slipped(made.touches, 3, np.array([0.0012, -0.0009, 0.0]))
    done = tcp(tmp_path, wrong, "--json")
    tool = found(done)
    (reason,) = tool["verdict"]["reasons"]
    assert reason.startswith("Touch 4 (touches.csv, line 5) was left out: 1.")
    assert "the tip had slipped" in reason
    assert tool["verdict"]["status"] == "check"
    assert [value["name"] for value in tool["observations"] if not value["used"]] == ["4"]
    assert off_mm(tool) < NEAR_MM


@pytest.mark.slow
def test_a_wrong_touch_among_few_is_named_where_it_cannot_be_left_out(tmp_path):
    """Of six touches with 0.3 mm of noise, one that slipped by 2.4 mm is not certain."""
    named, sound = 0, 0
    for seed in range(10):
        made = touched(Job(tips=6, contact_m=3e-4), seed)
        wrong = slipped(made.touches, 3, np.array([0.0, 0.0024, 0.0]))
        reasons = found(tcp(tmp_path, wrong, "--json"))["verdict"]["reasons"]
        named += reasons[0].startswith("Touch 4 (touches.csv, line 5)")
        rest = found(tcp(tmp_path, made.touches, "--json"))["verdict"]
        sound += any("the likeliest to be wrong" in reason for reason in rest["reasons"])
    # Nine of ten, and one of twenty that is sound.
    assert named >= 8
    assert sound <= 2


def test_few_or_noisy_touches_are_doubted(tmp_path):
    words = tcp(tmp_path, touched(Job(tips=3), 7).touches).out
    assert "Only 3 touches of a point are used" in words
    noisy = tcp(tmp_path, touched(Job(tips=12, contact_m=1e-3), 8).touches).out
    assert "mm only (per axis; doubt begins at 0.5)" in noisy
    flat = tcp(tmp_path, touched(Job(cone_deg=4.0), 9).touches).out
    assert "Add touches tilted by 30 to 45 degrees" in flat
    stated = tcp(tmp_path, touched(Job(), 10).touches, "--touch-noise-mm", "0.02").out
    assert "scatter by more than they are stated to" in stated


def test_another_order_of_the_quaternion_is_a_bad_tool(tmp_path):
    poses = touched(Job(), 11).touches.base_from_flange
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = np.hstack([poses[:, :3, 3], np.roll(turns, 1, axis=1)]).tolist()
    path = write_table(tmp_path / "touches.csv", POSE, rows)
    done = visioncal("tcp", path)
    assert done.status == 3
    assert "with their rotations in another form, quaternion-wxyz; and to" in done.out
    assert "--robot-form quaternion-wxyz" in done.out.partition("What to do next")[2]
    assert visioncal("tcp", path, "--robot-form", "quaternion-wxyz").good()


def test_poses_by_joint_angles_have_no_other_reading(tmp_path):
    """Angles of no common point: a bad tool, by numbers that are in no column."""
    bent = np.array([0.0, -1.2, 1.5, -1.8, -1.5, 0.0])
    angles = bent + np.random.default_rng(3).uniform(-1.0, 1.0, (8, 6))
    names = [f"q{at}_rad" for at in range(1, 7)]
    path = write_table(tmp_path / "touches.csv", names, angles.tolist())
    done = visioncal("tcp", path, "--robot-model", "ur5e")
    assert done.status == 3
    assert "The touches agree to" in done.out
    assert "another form" not in done.out


def test_touches_of_another_point_are_named(tmp_path):
    """Four of ten are of a point that has no name."""
    poses = touched(Job(), 12).touches.base_from_flange.copy()
    poses[6:, :3, 3] += [0.1, -0.2, 0.05]
    done = visioncal("tcp", write_poses(tmp_path / "touches.csv", poses))
    assert "Touches 6, 7, 8, 9 (touches.csv, line 8 and below) agree on a point" in done.out
    names = ["a"] * 6 + ["b"] * 4
    visioncal("tcp", write_poses(tmp_path / "named.csv", poses, {"point": names})).good()


@pytest.mark.parametrize(("count", "status"), [(3, 2), (4, 3)])
def test_as_many_touches_of_another_point_are_named(tmp_path, count, status):
    """As one point they refuse a tip, or give a bad one."""
    poses = touched(Job(tips=2 * count), 12).touches.base_from_flange.copy()
    poses[count:, :3, 3] += [0.1, -0.2, 0.05]
    done = visioncal("tcp", write_poses(tmp_path / "touches.csv", poses))
    assert done.status == status
    words = f"Touches {', '.join(map(str, range(count, 2 * count)))} (touches.csv"
    assert words in next(line for line in (done.out + done.err).splitlines() if "Touches" in line)
    assert "agree on a point of their own, 229 mm from that of the others" in done.out + done.err


# --- What cannot be is refused.


def test_too_few_touches_are_refused(tmp_path):
    tcp(tmp_path, touched(Job(tips=2), 1).touches, "-o", tmp_path / "frames.json").refused(
        "2 touches of kind point", "at least 3 of one point", "tilted by 20 to 45"
    )
    assert not (tmp_path / "frames.json").exists()
    poses = touched(Job(), 1).touches.base_from_flange[:4]
    axes = write_poses(tmp_path / "axes.csv", poses, {"kind": ["z"] * 4})
    visioncal("tcp", axes).refused("0 touches of kind point")


def test_touches_that_turn_about_one_axis_name_what_is_open(tmp_path):
    poses = touched(Job(), 1).touches.base_from_flange.copy()
    spins = Rotation.from_rotvec(np.outer(np.linspace(-1.5, 1.5, 10), [0, 0, 1.0])).as_matrix()
    met = poses[0, :3, :3] @ TIP + poses[0, :3, 3]
    poses[:, :3, :3] = poses[0, :3, :3] @ spins
    poses[:, :3, 3] = met - poses[:, :3, :3] @ TIP
    visioncal("tcp", write_poses(tmp_path / "touches.csv", poses)).refused(
        "the tip's offset along the flange's z is not determined at all"
    )


def test_wrong_rows_are_refused_by_their_place(tmp_path):
    touches = touched(Job(), 1).touches
    path = file_of(tmp_path / "touches.csv", touches)
    lines = path.read_text().splitlines()

    def run(text):
        path.write_text(text)
        return visioncal("tcp", path)

    run("\n".join([*lines, lines[3].replace("3,", "11,", 1)])).refused(
        "touches.csv, line 4 and touches.csv, line 12 have the same pose"
    )
    run("\n".join(lines).replace("2,point", "2,pint")).refused(
        "touches.csv, line 3: kind is 'pint'", "Did you mean point?"
    )
    run("\n".join(lines).replace("2,point", "2,origin")).refused(
        "kind is 'origin'", "point, z, xz or nothing"
    )
    run("\n".join(lines).replace(lines[2].split("point")[1], "," * 7)).refused(
        "touches.csv, line 3: no pose of the robot"
    )
    run("x,y\n1,2\n").refused("which of its fields are the robot's poses is not known")
    visioncal("tcp", tmp_path / "nowhere.csv").refused("nowhere.csv does not exist")


# --- What it writes.


def test_a_file_of_frames_is_made_extended_and_kept(tmp_path):
    touches, path = touched(Job(), 1).touches, tmp_path / "frames.json"
    assert f"wrote {path}" in tcp(tmp_path, touches, "-o", path).good().err
    first = FrameFile.load(path).frames["flange_from_tool"]
    assert tcp(tmp_path, touches, "-o", path, "--name", "gripper").status == 0
    assert list(FrameFile.load(path).frames) == ["flange_from_tool", "flange_from_gripper"]
    other = touched(Job(), 2).touches
    tcp(tmp_path, other, "-o", path).refused("already has flange_from_tool", "--force")
    kept = FrameFile.load(path).frames["flange_from_tool"]
    assert np.array_equal(kept.edge.matrix, first.edge.matrix)
    assert tcp(tmp_path, other, "-o", path, "--force").status == 0
    replaced = FrameFile.load(path).frames["flange_from_tool"]
    assert not np.array_equal(replaced.edge.matrix, first.edge.matrix)
    path.write_text("{}")
    tcp(tmp_path, touches, "-o", path).refused("not frames that this version can read")


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrated")
    write_session(simulate(CellOptions(views=10, seed=3)), folder / "cell", images=False)
    session = Session.load(folder / "cell")
    write_outputs(folder / "out", session, run(session))
    return folder / "out"


@pytest.fixture
def out(calibrated, tmp_path):
    return Path(shutil.copytree(calibrated, tmp_path / "out"))


def test_a_tool_joins_its_calibration(out, tmp_path):
    before = Calibration.load(out)
    touches = touched(Job(axes=3), 1).touches
    done = tcp(tmp_path, touches, "-c", out, "--name", "gripper").good()
    assert all(f"wrote {out / name}" in done.err for name in ("calibration.json", "recording.rrd"))
    after = Calibration.load(out)
    assert list(after.frames) == ["flange_from_gripper"]
    for name, edge in before.edges.items():
        assert np.array_equal(after.edges[name].matrix, edge.matrix)
    assert "flange_from_gripper" in (out / "report.html").read_text(encoding="utf-8")
    recorded = read_calibration(out / "recording.rrd").frames["flange_from_gripper"]
    matrix = after.frames["flange_from_gripper"].edge.matrix
    assert np.array_equal(recorded.edge.matrix, matrix)
    exported = visioncal("export", out, "--to", "ur-tcp").good()
    numbers = exported.out.partition("set_tcp(p[")[2].partition("]")[0].split(",")
    # Nanometres are written.
    assert np.array(numbers[:3], dtype=float) == pytest.approx(matrix[:3, 3], abs=1e-8)
    tcp(tmp_path, touches, "-c", out, "--name", "gripper").refused("already has")
    again = tcp(tmp_path, touches, "-c", out, "--name", "gripper", "--force")
    assert "it replaces the one of" in again.err
    # A fixture of the same name would hang the frame in two places.
    visioncal("fixture", tmp_path / "touches.csv", "-c", out, "--name", "gripper").refused(
        "'gripper' is taken: flange_from_gripper already exists"
    )
    whole = (out / "calibration.json").read_bytes()
    tcp(tmp_path, touches, "-o", out / "calibration.json").refused("is a calibration", "-c")
    assert (out / "calibration.json").read_bytes() == whole
    elsewhere = tmp_path / "frames.json"
    assert tcp(tmp_path, touches, "-c", out, "-o", elsewhere).status == 0
    assert list(Calibration.load(out).frames) == ["flange_from_gripper"]


def test_a_fixture_is_touched_with_the_calibrations_tool(out, tmp_path):
    touches = touched(Job(axes=3), 1).touches
    path = file_of(tmp_path / "touches.csv", touches)
    visioncal("fixture", path, "-c", out).refused("The calibration has no tool", "--tool none")
    assert tcp(tmp_path, touches, "-c", out).status == 0
    kinds = ["origin", "x", "xy"] * 2
    poses = np.tile(touches.base_from_flange[0], (6, 1, 1))
    poses[:, :2, 3] += [[0, 0], [0.2, 0], [0.1, 0.2], [0.0, 1e-4], [0.3, 0], [0.0, 0.3]]
    path = write_poses(tmp_path / "fixture.csv", poses, {"kind": kinds})
    visioncal("fixture", path, "-c", out).good()
    fixture = Calibration.load(out).frames["base_from_fixture"]
    assert fixture.details["tool"]["name"] == "flange_from_tool"
    # Along the base's axes by construction, to 0.1 mm over 0.3 m.
    assert np.abs(fixture.edge.matrix[:3, :3] - np.eye(3)).max() < 1e-3
    assert "base_from_fixture" in (out / "report.html").read_text(encoding="utf-8")
    assert "PERS wobjdata" in visioncal("export", out, "--to", "abb-wobjdata").good().out


def test_a_bad_tool_is_shown_and_does_not_join(out, tmp_path):
    before = (out / "calibration.json").read_bytes()
    touches = touched(Job(), 1).touches
    # Of anything else: the flange is anywhere within centimetres.
    scattered = replace(
        touches, base_from_flange=touches.base_from_flange + _shifted(len(touches), 0.03)
    )
    done = tcp(tmp_path, scattered, "-c", out, "--name", "gripper")
    assert done.status == 3
    assert done.out.startswith("bad")
    assert "does not join" in done.err
    assert tcp(tmp_path, scattered, "-c", out, "--name", "gripper", "--json").status == 3
    assert (out / "calibration.json").read_bytes() == before
    # A file of frames keeps it, and what would use it refuses.
    file = tmp_path / "frames.json"
    assert tcp(tmp_path, scattered, "-o", file, "--name", "gripper").status == 3
    assert visioncal("export", file, "--to", "ur-tcp").status == 3
    assert visioncal("export", file, "--to", "ur-tcp", "--force").status == 0


def _shifted(count, sigma_m):
    shifts = np.zeros((count, 4, 4))
    shifts[:, :3, 3] = sigma_m * np.random.default_rng(3).standard_normal((count, 3))
    return shifts
