"""Fixtures from touches: the answer and its sigma, what is refused or named, and the command."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import placed as made
from support.commands import turned_poses, visioncal, write_poses, write_table
from support.marks import slow
from support.parts import away, placed, some_frame
from support.samples import made_up

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp
from visioncal.estimation.problem_parts import Noise
from visioncal.frames.fixture import FitSettings, drawn_fixture, touched_fixture
from visioncal.frames.touches import NominalPoints, Tool, TouchRows, check_lengths, touched_points
from visioncal.results import Edge, FrameFile, Verdict

TIP = made.FLANGE_FROM_TOOL[:3, 3]
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


def rows_of(poses, kinds=None, points=None):
    blank = ("",) * len(poses)
    labels = tuple(str(index) for index in range(1, len(poses) + 1))
    places = tuple(f"touches.csv, line {index + 1}" for index in range(1, len(poses) + 1))
    return TouchRows("touches.csv", labels, places, poses, None, kinds or blank, points or blank)


def drawing(points_m, names=NAMES):
    return NominalPoints("cad.csv", names[: len(points_m)], points_m, np.zeros(len(points_m)))


def touching(points_m, rng, noise_m=0.0, tip=TIP):
    """Poses that touch points (n, 3) of the fixture, each tilted its way."""
    met = placed(FRAME, points_m) + noise_m * rng.normal(size=points_m.shape)
    return turned_poses(rng, met, tip, FRAME[:3, :3])


def drawn(points_mm, names, *, seed=1, noise_m=NOISE_M, cad_mm=CAD_MM, cad_names=NAMES, **options):
    rng = np.random.default_rng(seed)
    poses = touching(1e-3 * np.asarray(points_mm, dtype=float), rng, noise_m)
    cad = drawing(1e-3 * np.asarray(cad_mm, dtype=float), cad_names)
    return touched_fixture(rows_of(poses, points=tuple(names)), tool(), cad, **options)


# --- The answer.


def test_exact_touches_give_the_exact_fixture():
    rng = np.random.default_rng(0)
    by_features = touched_fixture(rows_of(touching(ON_FEATURES, rng), kinds=KINDS), tool())
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


@pytest.mark.parametrize("features", [False, True])
def test_the_tips_error_is_a_pure_offset_where_all_touches_stand_alike(features):
    rng = np.random.default_rng(2)
    local = ON_FEATURES if features else 1e-3 * CAD_MM
    met = placed(FRAME, local) + NOISE_M * rng.normal(size=local.shape)
    turn = Rotation.from_rotvec([3.0, 0.3, -0.2]).as_matrix()
    poses = compose(np.tile(turn, (len(met), 1, 1)), met - turn @ TIP)
    rows = rows_of(poses, KINDS) if features else rows_of(poses, points=NAMES)
    cad = None if features else drawing(local)
    exact, unsure = (touched_fixture(rows, tool(item), cad) for item in (None, TIP_SIGMA))
    assert np.array_equal(exact.edge.matrix, unsure.edge.matrix)
    more = unsure.edge.covariance - exact.edge.covariance
    turned = unsure.edge.matrix[:3, :3].T @ turn @ made.FLANGE_FROM_TOOL[:3, :3] @ TIP_SIGMA
    # Of variances of 1e-7, through inverses of 1e8.
    assert np.abs(more[3:, 3:] - turned @ turned.T).max() < 1e-12
    assert np.abs(more[:3]).max() < 1e-12


@pytest.mark.parametrize("features", [slow(False), slow(True)])
def test_the_error_over_its_sigma_is_as_it_should_be(features):
    squares = []
    noise = Noise.of_robot(1e-4, 3e-5)
    local = np.tile(ON_FEATURES, (2, 1)) if features else 1e-3 * CAD_MM
    kinds = KINDS * 2 if features else ("",) * len(local)
    known = {"robot_rotation_deg": np.rad2deg(noise.robots[0, 0]), "robot_translation_mm": 0.03}
    calibration = replace(made_up(5).calibration, noise=known)
    for seed in range(50):
        rng = np.random.default_rng(seed)
        off = made.FLANGE_FROM_TOOL[:3, :3] @ TIP_SIGMA @ rng.normal(size=3)
        poses = touching(local, rng, NOISE_M, TIP + off)
        sigmas = np.repeat(noise.robots[0], 3)
        poses = poses @ exp(sigmas * rng.normal(size=(len(poses), 6)))
        frame = touched_fixture(
            rows_of(poses, kinds, () if features else NAMES),
            tool(TIP_SIGMA),
            None if features else drawing(local),
            calibration,
        )
        error = away(frame.edge.matrix, FRAME)
        squares.append(error @ np.linalg.solve(frame.edge.covariance, error))
    # Six, a little more since the noise's level is estimated from some 20 residuals; the mean of
    # 50 has a standard deviation of 0.5.
    assert 4.6 < np.mean(squares) < 8.2


@pytest.mark.slow
def test_touches_that_scatter_by_the_tip_are_not_called_wrong():
    # Its error is known, and shows where the flange is turned about: here by ten times a touch.
    for seed in range(20):
        rng = np.random.default_rng(seed)
        met = placed(FRAME, 1e-3 * CAD_MM) + 2e-5 * rng.normal(size=CAD_MM.shape)
        down = Rotation.from_rotvec([np.pi, 0.0, 0.0])
        # One of them with the flange turned half around.
        turns = Rotation.from_rotvec(np.outer(np.arange(8) == 4, [0.0, 0.0, np.pi])) * down
        off = made.FLANGE_FROM_TOOL[:3, :3] @ (2e-4 * rng.normal(size=3))
        poses = compose(turns.as_matrix(), met - turns.apply(TIP + off))
        rows = rows_of(poses, points=NAMES)
        frame = touched_fixture(rows, tool(2e-4 * np.eye(3)), drawing(1e-3 * CAD_MM))
        assert all(observation.used for observation in frame.observations)


def test_three_touches_say_what_their_sigma_rests_on():
    poses = touching(ON_FEATURES[[0, 1, 3]], np.random.default_rng(3))
    rows = rows_of(poses, ("origin", "x", "xy"))
    assumed, stated = (touched_fixture(rows, tool(), touch_noise_m=item) for item in (None, 3e-4))
    assert assumed.verdict.status == "check"
    assert "0.1 mm, which is assumed" in assumed.verdict.reasons[0]
    assert "assumed" not in stated.verdict.reasons[0]
    assert assumed.noise_mm == pytest.approx(0.1)
    assert np.allclose(stated.edge.covariance, 9 * assumed.edge.covariance, rtol=1e-6)


@pytest.mark.parametrize(
    "chosen",
    [[0, 1, 3, 4], slow([0, 1, 3, 4, 6, 6])],
    ids=["four", "six"],
)
def test_few_touches_that_agree_by_chance_are_not_believed(chosen):
    kinds = tuple(KINDS[index] for index in chosen)
    squares = []
    for seed in range(100):
        poses = touching(ON_FEATURES[chosen], np.random.default_rng(seed), NOISE_M)
        frame = touched_fixture(rows_of(poses, kinds), tool())
        error = away(frame.edge.matrix, FRAME)
        squares.append(error @ np.linalg.solve(frame.edge.covariance, error))
    # Chi-square of six stays under 41, five sigmas, in all but one case of a million.
    assert max(squares) < 41.0
    exact = touching(ON_FEATURES[chosen], np.random.default_rng(0))
    (reason,) = touched_fixture(rows_of(exact, kinds), tool()).verdict.reasons
    assert "0.1 mm, which is assumed" in reason


def test_three_drawn_points_that_agree_by_chance_are_not_believed():
    squares = []
    for seed in range(40):
        frame = drawn(CAD_MM[:3], NAMES[:3], seed=seed)
        error = away(frame.edge.matrix, FRAME)
        squares.append(error @ np.linalg.solve(frame.edge.covariance, error))
    assert max(squares) < 41.0  # as above
    exact = drawn(CAD_MM[:3], NAMES[:3], noise_m=0.0)
    assert any("0.1 mm, which is assumed" in reason for reason in exact.verdict.reasons)
    stated = drawn(CAD_MM[:3], NAMES[:3], noise_m=0.0, touch_noise_m=3e-4)
    assert stated.noise_mm == pytest.approx(0.3)


# --- What is wrong is named.


def test_a_wrong_point_is_left_out_and_named():
    points = CAD_MM.astype(float)
    points[4] += [2.0, 0.0, 1.0]
    frame = drawn(points, NAMES)
    (reason,) = frame.verdict.reasons
    assert reason.startswith("Point P5 (touches.csv, line 6) was left out: 2.")
    assert frame.verdict.status == "check"
    assert [observation.name for observation in frame.observations if not observation.used] == [
        "P5"
    ]
    # Of eight points with a noise of 0.1 mm, the others place it to 0.05 mm.
    assert np.abs(frame.edge.matrix - FRAME).max() < 5e-4


def test_a_wrong_touch_of_a_feature_is_left_out_and_named():
    local = np.vstack([ON_FEATURES, ON_FEATURES + [0.01, 0.02, 0.0] * (ON_FEATURES > 0)])
    local[6, 2] += 0.004
    poses = touching(local, np.random.default_rng(6), 5e-5)
    frame = touched_fixture(rows_of(poses, KINDS * 2), tool())
    assert [observation.name for observation in frame.observations if not observation.used] == ["7"]
    assert frame.verdict.reasons[0].startswith("Touch 7 (touches.csv, line 8) was left out: ")


def test_two_exchanged_names_are_named():
    names = ("P1", "P2", "P7", *NAMES[3:6], "P3", "P8")
    frame = drawn(CAD_MM, names)
    words = " ".join(frame.verdict.reasons)
    assert "it is where P3 is drawn: is its name exchanged?" in words
    assert "it is where P7 is drawn: is its name exchanged?" in words
    (step,) = {finding.do.words for finding in frame.verdict.findings if finding.kind == "left_out"}
    assert step.startswith("Correct the names of what is named")
    assert {observation.name for observation in frame.observations if not observation.used} == {
        "P3",
        "P7",
    }
    few = (0, 1, 4, 5)
    with pytest.raises(DataError, match="P5 and P6 are exchanged"):
        drawn(CAD_MM[[0, 1, 5, 4]], [NAMES[index] for index in few])


def test_exchanged_names_are_no_size_of_the_part():
    """The five points that are left fit their drawing through its middle, too."""
    near = [[4, 135, 15], [-107, 135, 23], [-56, -23, 7], [98, -27, 20], [15, -142, 10]]
    points = np.array([*near, [76, 11, 13], [-51, 87, 38]])
    names = tuple(f"P{index}" for index in range(7))
    swapped = ("P0", "P4", "P2", "P3", "P1", "P5", "P6")
    frame = drawn(points, swapped, cad_mm=points, cad_names=names)
    assert "is its name exchanged?" in frame.verdict.reasons[0]
    assert "times as large as drawn" not in " ".join(frame.verdict.reasons)


def test_a_point_that_was_touched_several_times_counts_as_one():
    frame = drawn(np.vstack([CAD_MM, CAD_MM[:4]]), NAMES + NAMES[:4])
    assert frame.method == "best fit of 12 touches of 8 points to cad.csv"
    assert [observation.name for observation in frame.observations[-2:]] == ["P3, 11", "P4, 12"]
    assert frame.observations[4].name == "P5"
    assert frame.verdict.status == "good"
    twice = ("P1", "P2", "P6", "P5") * 3
    with pytest.raises(DataError, match=r"P6 and P5 are exchanged|P5 and P6 are exchanged"):
        drawn(np.tile(CAD_MM[[0, 1, 4, 5]], (3, 1)), twice)
    with pytest.raises(DataError, match="2 measured points"):
        drawn(np.tile(CAD_MM[:2], (3, 1)), NAMES[:2] * 3)


def test_a_part_of_another_size_is_told_and_not_absorbed():
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
    alone = touched_fixture(rows_of(poses, points=NAMES[:5]), None, cad)
    assert "a mirrored drawing would fit them as well" in alone.verdict.reasons[0]


def test_a_symmetric_pattern_is_told():
    frame = drawn(CAD_MM[:4], NAMES[:4], cad_mm=CAD_MM[:4], cad_names=NAMES[:4])
    assert "in 4 orders alike" in " ".join(frame.verdict.reasons)
    assert frame.verdict.status == "check"


def test_few_noisy_or_uncertain_points_are_doubted():
    words = " ".join(drawn(CAD_MM[:3], NAMES[:3]).verdict.reasons)
    assert "Only 3 points are used" in words
    noisy = drawn(CAD_MM, NAMES, noise_m=1e-3)
    assert "mm only (per axis; doubt begins at 0.5)" in " ".join(noisy.verdict.reasons)
    stated = drawn(CAD_MM, NAMES, noise_m=3e-4, touch_noise_m=5e-5)
    assert "scatter by more than they are stated to" in " ".join(stated.verdict.reasons)
    rng = np.random.default_rng(1)
    rows = rows_of(touching(1e-3 * CAD_MM, rng, NOISE_M), points=NAMES)
    unsure = touched_fixture(rows, tool(1e-3 * np.eye(3)), drawing(1e-3 * CAD_MM))
    assert "is known to 1 mm only" in unsure.verdict.reasons[0]


@pytest.mark.parametrize(("tools", "fixtures"), [("check", "check"), ("bad", "bad")])
def test_a_tool_in_doubt_makes_its_fixture_doubtful(tools, fixtures):
    rows = rows_of(touching(1e-3 * CAD_MM, np.random.default_rng(1), NOISE_M), points=NAMES)
    doubtful = tool(verdict=Verdict.of(tools, "The tip wobbles."))
    frame = touched_fixture(rows, doubtful, drawing(1e-3 * CAD_MM))
    assert frame.verdict.status == fixtures
    assert "flange_from_tool, is in doubt itself" in frame.verdict.reasons[0]
    assert "The tip wobbles." in frame.verdict.reasons[0]


def test_errors_that_points_share_are_carried_to_the_answer():
    # As a camera's: another covariance than a tip's, for all points together.
    rng = np.random.default_rng(8)
    rows = rows_of(touching(1e-3 * CAD_MM, rng), points=NAMES)
    measured = touched_points(rows, tool(), Noise.of_robot(0.0, 1e-6), None)
    # As if the whole set were turned about the base, and shifted.
    sigmas = np.array([1e-4, 2e-4, 3e-4, 1e-4, 1e-4, 5e-5])
    jacobian = np.concatenate([sigmas * _turning(point) for point in measured.points])
    shared = replace(measured, common=jacobian @ jacobian.T)
    found = drawn_fixture(shared, drawing(1e-3 * CAD_MM), FitSettings()).edge
    moves = []
    for step in np.diag(sigmas):
        moved = [placed(exp(sign * step), measured.points) for sign in (1.0, -1.0)]
        ahead, behind = (
            drawn_fixture(
                replace(measured, points=array), drawing(1e-3 * CAD_MM), FitSettings()
            ).edge
            for array in moved
        )
        moves.append(0.5 * away(behind.matrix, ahead.matrix))
    # What is each point's own is a hundredth of it: 1e-4 of the variance.
    expected = np.array(moves).T @ np.array(moves)
    assert np.abs(found.covariance - expected).max() < 1e-3 * np.abs(expected).max()


def _turning(point):
    """How a point (3,) of the base moves with a small (6,) motion of the whole base."""
    x, y, z = point
    cross = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    return np.hstack([cross, np.eye(3)])


def test_a_position_whose_square_overflows_is_far_off():
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 0, 3] = 1e300
    with pytest.raises(DataError, match=r"line 3: its position is 1e\+300 m from the base"):
        check_lengths(rows_of(poses))


# --- The command.


@pytest.fixture
def tool_file(tmp_path):
    path = tmp_path / "frames.json"
    made.alone(made.tool()).save(path)
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


def test_the_fixture_goes_into_a_file_beside_the_tool(tmp_path, tool_file):
    done = fixture(tmp_path, tool_file, "-o", tool_file, "--name", "jig")
    assert done.status == 0
    assert done.out.startswith("good  base_from_jig")
    frames = FrameFile.load(tool_file).frames
    assert list(frames) == ["flange_from_tool", "base_from_jig"]
    # The tip's sigma, 0.2 mm, is most of it.
    assert np.abs(frames["base_from_jig"].edge.matrix - FRAME).max() < 5e-4
    assert frames["base_from_jig"].details["tool"]["name"] == "flange_from_tool"
    again = fixture(tmp_path, tool_file, "-o", tool_file, "--name", "jig")
    assert again.status == 2
    assert "already has base_from_jig" in again.err
    assert fixture(tmp_path, tool_file, "-o", tool_file, "--name=jig", "--force").status == 0


MIRRORED = CAD_MM * [1, -1, 1]
LINE = np.outer(np.arange(8), [50, 0, 0])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"points_mm": MIRRORED}, "mirror image of the drawing"),
        ({"points_mm": LINE[:6], "names": NAMES[:6]}, "the points do not fit the drawing"),
        ({"points_mm": CAD_MM[:2], "names": NAMES[:2]}, "at least 3 are needed"),
        ({"scale": 1000.0}, "these look like millimetres. "),
        ({"scale": 0.001}, "metres read as millimetres"),
        ({"names": NAMES[::-1]}, "in another order"),
        ({"names": ("p1", "P22", *NAMES[2:])}, "cad.csv has no point P22; it has P1, P2"),
        ({"names": ("", *NAMES[1:])}, "touches.csv, line 2: which point was touched is not said"),
        ({"names": ("",) * 8}, "touches.csv: which point was touched is not said"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, tool_file, changes, words):
    done = fixture(tmp_path, tool_file, "-o", tmp_path / "new.json", **changes)
    assert done.status == 2
    assert words in done.err.replace("\n", " ")
    assert not (tmp_path / "new.json").exists()


def test_a_drawing_on_a_line_is_refused(tmp_path, tool_file):
    cad = cad_file(tmp_path / "cad.csv", LINE)
    touches = touches_file(tmp_path / "touches.csv", LINE)
    done = visioncal("fixture", touches, "--cad", cad, "--tool", tool_file)
    assert done.status == 2
    assert "the fixture's rotation about its x has a predicted sigma of" in done.err


def test_features_need_their_kinds(tmp_path, tool_file):
    poses = touching(ON_FEATURES, np.random.default_rng(1), NOISE_M)
    touches = tmp_path / "touches.csv"

    def run(kinds, *more):
        write_poses(touches, poses[: len(kinds)], {"kind": kinds})
        return visioncal("fixture", touches, "--tool", tool_file, *more)

    assert run(KINDS).status == 0
    for kinds, words in (
        (("",) * 7, "there is no kind; one of origin, x, xy is needed"),
        (("orgin", *KINDS[1:]), "line 2: kind is 'orgin'"),
        (KINDS[:3], "no touch of kind xy"),
        (KINDS[:2], "no touch of kind xy"),
    ):
        done = run(kinds)
        assert done.status == 2
        assert words in done.err
    assert "Did you mean origin?" in run(("orgin", *KINDS[1:])).err
    assert "--cad" in run(("",) * 7).err
    done = run(KINDS, "--cad", cad_file(tmp_path / "cad.csv"))
    assert done.status == 2
    assert "Leave --cad away" in done.err


def test_touches_on_a_line_are_refused_with_the_rotation_that_is_open(tmp_path, tool_file):
    line = 1e-3 * np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [300.0, 0.0, 0.0]])
    poses = touching(line, np.random.default_rng(2), NOISE_M)
    touches = write_poses(tmp_path / "touches.csv", poses, {"kind": ["origin", "x", "xy"]})
    done = visioncal("fixture", touches, "--tool", tool_file)
    assert done.status == 2
    assert "the fixture's rotation about its x has a predicted sigma of" in done.err
    assert "at a noise of 0.1 mm" in done.err


def test_units_of_the_drawing(tmp_path, tool_file):
    touches = touches_file(tmp_path / "touches.csv")

    def run(columns, *more):
        cad = cad_file(tmp_path / "cad.csv", columns=columns)
        return visioncal("fixture", touches, "--tool", tool_file, "--cad", cad, *more)

    assert run(("X", "Y", "Z"), "--cad-unit", "mm").status == 0
    assert run(("X_mm", "Y_mm", "Z_mm")).status == 0
    # Who says a unit has seen that the names are wrong.
    assert run(("x_m", "y_m", "z_m"), "--cad-unit", "mm").status == 0
    for done, words in (
        (run(("x_m", "y_m", "z_m")), "times as large as drawn"),
        (run(("x", "y", "z")), "x, y, z are in no unit that is named"),
        (run(("x", "y", "z"), "--cad-unit", "mn"), "no unit of length named 'mn'"),
        (run(("a", "b", "c")), "columns x_mm, y_mm, z_mm or x_m, y_m, z_m are needed"),
    ):
        assert done.status == 2
        assert words in done.err


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
    assert "sigma_um is negative" in visioncal("fixture", touches, "--cad", cad, "--tool=none").err


def test_spare_points_of_the_drawing_are_kept_in_mind(tmp_path, tool_file):
    done = fixture(tmp_path, tool_file, "--json", points_mm=CAD_MM[:6], names=NAMES[:6])
    details = json.loads(done.out)["base_from_fixture"]["details"]
    assert details["spare_points"] == ["P7", "P8"]
    names = (*NAMES[:5], "P7")
    done = fixture(tmp_path, tool_file, points_mm=CAD_MM[:6], names=names)
    assert done.status == 0
    assert "it is where P6 is drawn" in done.out


def test_which_tool_touched(tmp_path, tool_file):
    cad, touches = cad_file(tmp_path / "cad.csv"), touches_file(tmp_path / "touches.csv")
    two = tmp_path / "two.json"
    frames = {"flange_from_gripper": made.frame(made.FLANGE_FROM_TOOL), **made.tool()}
    made.alone(frames).save(two)

    def run(*more):
        return visioncal("fixture", touches, "--cad", cad, *more)

    assert run("--tool", f"{two}:gripper").status == 0
    assert run("--tool", f"{tool_file}:flange_from_tool").status == 0
    for done, words in (
        (run(), "The tool that touched the points is not said"),
        (run("--tool", two), "has 2 tools: flange_from_gripper, flange_from_tool"),
        (run("--tool", f"{two}:griper"), "Did you mean flange_from_gripper"),
        (run("--tool", "gripper"), "there is no such file"),
    ):
        assert done.status == 2
        assert words in done.err
    assert "--tool none" in run().err


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
        run(("X", "Y", "Z"), *none, "--robot-unit", "mm"),
        run(("X", "Y", "Z"), *none, "--robot-form", "kuka"),
        run(("a", "b", "c"), *none, "--robot-columns", "a,b,c", "--robot-unit", "mm"),
    ):
        found = json.loads(done.out)["base_from_fixture"]
        # Eight points of 0.1 mm over 0.3 m.
        assert np.abs(np.array(found["matrix"]) - FRAME).max() < 5e-4
    assert "are in no unit that is named" in run(("X", "Y", "Z"), *none).out
    assert "these look like millimetres" in run(("x_m", "y_m", "z_m"), *none).out
    assert "say --tool none" in run(("x_mm", "y_mm", "z_mm"), "--tool", tool_file).out
    write_table(touches, ("q1_rad", "q2_rad"), [[0.1, 0.2]] * 8, {"point": NAMES})
    done = visioncal("fixture", touches, "--cad", cad, *none)
    assert done.status == 2
