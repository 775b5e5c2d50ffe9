"""The guard, by a board or a standing scene: rows of a look, alarms, names, refusals, commands."""

import io
import json
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.commands import visioncal
from support.later import FITTED, Change, again, knock, usual
from support.marks import slow
from support.refusals import raised
from support.scenes import CAMERA, Scene, disturbed, turned
from support.wrong_arms import target_in_camera

from visioncal import Guard, Look
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp
from visioncal.session import View
from visioncal.session.columns import POSE
from visioncal.verification.guard_detector import Detector, counted, limit
from visioncal.verification.scene_guard import SceneWatch, scene_plane
from visioncal.vision.scene import register

MOUNTS = ("eye-in-hand", "eye-to-hand")
HOUR_S = 3600.0


def looks(place, rng, count, change=None, start=0):
    """Looks of a cell an hour apart, as a detector of corners sends them."""
    for first in range(0, count, 60):
        fresh = again(place.cell, rng, change, min(60, count - first))
        for at, corners in enumerate(fresh.corners):
            yield Look(
                time_s=HOUR_S * (start + first + at),
                base_from_flange=fresh.robot.base_from_flange[at],
                corners=corners,
                joints_rad=fresh.robot.joints[at],
            )


def white(rows, rng, time_s, factor=1.0):
    """A look at that posture, whose residual is the noise of its covariance alone."""
    noise = np.linalg.cholesky(rows.covariance) @ rng.standard_normal(6)
    return replace(rows, time_s=time_s, residual=factor * noise)


@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
def test_the_rows_of_a_look_are_its_derivatives_by_changes_of_the_cell(mount):
    place = usual(mount)
    guard, cell, at = Guard(place.calibration), place.cell, FITTED + 3
    q, step = cell.robot.joints[at], 1e-6
    seen = {"time_s": 0.0, "joints_rad": q, "cam_from_target": cell.cam_from_target[at]}
    rows = guard.rows(Look(**seen))
    edges = guard.prior.state.edges
    slopes = []
    for column in range(12):
        moved = edges.copy()
        moved[column // 6] = moved[column // 6] @ exp(step * np.eye(6)[column % 6])
        guard.prior = replace(guard.prior, state=replace(guard.prior.state, edges=moved))
        slopes.append((guard.rows(Look(**seen)).residual - rows.residual) / step)
        guard.prior = replace(guard.prior, state=replace(guard.prior.state, edges=edges))
    # Second order of a step of 1e-6, over it.
    np.testing.assert_allclose(-np.array(slopes).T, rows.by_motion, atol=1e-4)
    turned = [
        guard.rows(Look(**seen | {"joints_rad": q + step * axis})).residual for axis in np.eye(6)
    ]
    by_joints = (rows.residual - np.array(turned)).T / step
    np.testing.assert_allclose(by_joints, rows.by_joints, atol=1e-4)
    # As corners without noise it is the same look.
    corners = replace(cell.exact_corners[at], view=0)
    by_corners = guard.rows(Look(time_s=0.0, joints_rad=q, corners=corners))
    # With the errors of the calibrated lens.
    for name in ("residual", "by_edges", "by_motion", "by_joints", "posture"):
        np.testing.assert_allclose(getattr(by_corners, name), getattr(rows, name), atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("count", [500, 3000])
def test_false_alarms_are_as_rare_as_stated(count):
    guard = Guard(usual("eye-in-hand").calibration, false_alarm_looks=100.0)
    rng, alarms = np.random.default_rng(0), 0
    shown = [guard.rows(look) for look in looks(usual("eye-in-hand"), rng, 12)]
    for at in range(count):
        # One look of 50 is wrong, by a hundred times its noise.
        factor = 100.0 if rng.random() < 0.02 else 1.0
        if not guard.take(white(shown[at % 12], rng, HOUR_S * at, factor)).holds:
            alarms += 1
            guard.acknowledge()
        # Rounding of the widest entry, of (0.4 rad)^2: an indefinite one ends in no answer.
        assert np.linalg.eigvalsh(guard.document["state"]["covariance"])[0] > -1e-15
    # One in a hundred in the mean; beyond four sigma of Poisson's distribution above. While noise
    # is learned there are fewer.
    assert count / 1000 <= alarms <= count / 100 + 4 * np.sqrt(count / 100)


@pytest.mark.slow
@pytest.mark.parametrize("tail", [0.6, 1.2])
def test_the_limit_follows_the_tail_of_the_statistic(tail):
    rng, count = np.random.default_rng(3), 40_000
    state = Detector.of(np.eye(12), 1e-5, np.zeros(0))
    # At first as in theory.
    assert limit(state, 700.0) == pytest.approx(700.0)
    values = 5.0 * rng.random(count) ** (-1.0 / tail)
    for at, value in enumerate(values, 1):
        # Every look is a candidate of its own.
        born = np.array([[at, 0.0, 0.0, 1.0]])
        state = counted(replace(state, born=born, looks=np.array(float(at))), np.array([value]))
    for looks_between in (100.0, 3000.0):
        expected = 5.0 * looks_between ** (1.0 / tail)
        # Passings of the larger limit, of which there are some hundred or more: to four sigma.
        sigma = np.sqrt((200.0 / 5.0) ** tail / 20_000.0) / tail
        factor = np.exp(4.0 * sigma * (1.0 + np.log(max(looks_between, 200.0) / 200.0)))
        assert expected / factor < limit(state, looks_between) < factor * expected


@pytest.mark.parametrize("mount", [slow(MOUNTS[0]), MOUNTS[1]])
@pytest.mark.parametrize("names", [("camera", "joint 3"), slow(("camera", "board", "joint 3"))])
def test_a_change_is_named_with_its_size_and_time(mount, names):
    place, rng, learned = usual(mount), np.random.default_rng(1), 120
    guard = Guard(place.calibration)
    for look in looks(place, rng, learned - 1):
        assert guard.update(look).holds
    kept = json.loads(json.dumps(guard.document))
    changes = {
        "camera": Change(camera=knock(rng, 0.6, 0.06)),
        "board": Change(board=knock(rng, 0.6, 0.06)),
        "joint 3": Change(joints_rad=np.array([0.0, 0.0, 1e-3, 0.0, 0.0, 0.0])),
    }
    for name in names:
        change = changes[name]
        # The last look before it is wrong: it is no part of the change.
        wrong = looks(place, rng, 1, Change(board=knock(rng, 20.0, 1.0)), learned - 1)
        assert guard.restore(kept).update(next(wrong)).holds
        found = [guard.update(look) for look in looks(place, rng, 25, change, learned)]
        late = [answer.holds for answer in found].index(False)
        last = found[-1]
        best = last.causes[0]
        # Shifts of several sigma of a look, in noise as it is stated until it is learned.
        assert late < 12, name
        assert best.cause == name
        assert best.probability > 0.9
        assert sum(cause.probability for cause in last.causes) == pytest.approx(1.0)
        after, by = last.changed_s
        assert HOUR_S * (learned - 2) <= after <= HOUR_S * learned <= by
        size, sigma = (best.deg, best.sigma_deg) if "joint" in name else (best.mm, best.sigma_mm)
        true = np.rad2deg(1e-3) if "joint" in name else 0.6
        # What is estimated of a length has a bias of its sigma at most.
        assert abs(size - true) < 5.0 * sigma + 0.1 * true
        # What is learned is kept through a restart to the last bit.
        again_ = Guard(place.calibration).restore(json.loads(json.dumps(guard.document)))
        (look,) = looks(place, rng, 1, change, learned + 40)
        assert again_.update(look) == guard.update(look)
        # What is acknowledged is as it should be, and another change is found as soon.
        guard.acknowledge()
        assert all(guard.update(look).holds for look in looks(place, rng, 60, change, learned + 41))
        other = replace(
            change, **{"board" if name == "camera" else "camera": knock(rng, 0.6, 0.06)}
        )
        found = [guard.update(look) for look in looks(place, rng, 12, other, learned + 101)]
        assert found[-1].causes[0].cause == ("board" if name == "camera" else "camera")


# Of a camera: distance and angle of a change, and what names it; nothing where it is noise.
SIZES = ((0.1, 0.01, ""), (1.0, 0.1, "camera"), (10.0, 1.0, "camera"), (100.0, 10.0, "camera"),
         (300.0, 25.0, "camera"), (600.0, 5.0, None), (0.0, 60.0, "none of these"),
         (10.0, 90.0, "none of these"), (0.0, 120.0, "none of these"),
         (0.0, 180.0, "none of these"), (1500.0, 0.0, "none of these"),
         (8000.0, 179.0, "none of these"))  # fmt: skip


def posed(place, rng, count, change=None, start=0):
    """Looks by the target's pose, which may be anywhere: out of the image, behind the camera."""
    cell, change = place.cell, change or Change()
    x, z = cell.transforms.values()
    for at in range(start, start + count):
        fresh = again(cell, rng, change, 1)
        flange = fresh.robot.true_base_from_flange
        moved = x @ exp(change.camera), z @ exp(change.board)
        seen = target_in_camera(cell.options.mount, *moved, flange)[0]
        yield Look(
            time_s=HOUR_S * at,
            base_from_flange=fresh.robot.base_from_flange[0],
            cam_from_target=seen @ exp(2e-5 * rng.standard_normal(6)),
            joints_rad=fresh.robot.joints[0],
        )


@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
def test_changes_of_any_size_are_answered_and_beyond_the_model_something_else(mount):
    place, rng = usual(mount), np.random.default_rng(5)
    guard, kept = Guard(place.calibration), None
    for look in posed(place, rng, 60):
        assert guard.update(look).holds
    kept = json.loads(json.dumps(guard.document, allow_nan=False))
    for mm, deg, name in SIZES:
        for what in ("camera", "board", "joints_rad"):
            if what == "joints_rad" and not deg:
                continue
            twist = np.eye(6)[2] * np.deg2rad(deg) if what == "joints_rad" else knock(rng, mm, deg)
            changed = guard.restore(kept), Change(**{what: twist})
            found = [guard.update(look) for look in posed(place, rng, 9, changed[1], 60)]
            case = f"{what}, {mm} mm and {deg} deg"
            # What a PLC reads has no NaN, nor has what is kept.
            for document in (*(answer.document for answer in found), guard.document):
                json.dumps(document, allow_nan=False)
            if not name:
                continue
            # One wrong look is no alarm; two or three are.
            assert found[0].holds, case
            assert not found[-1].holds, case
            first = found[-1].causes[0]
            assert first.probability > 0.9, case
            expected = {"camera": {"board": "board", "joints_rad": "joint 3"}.get(what, "camera")}
            assert first.cause == expected.get(name, name) or name is None, case
            if name == "none of these":
                assert not found[1].holds, case
                assert first.mm is first.deg is None
                # As the calibration knows nothing of it, nothing is learned from it.
                guard.acknowledge()
                assert all(guard.update(look).holds for look in posed(place, rng, 5, start=70))


def test_one_look_beyond_the_model_changes_nothing():
    place, rng = usual("eye-in-hand"), np.random.default_rng(6)
    guard = Guard(place.calibration)
    for at, look in enumerate(posed(place, rng, 40)):
        deg, before = 170.0 * (at % 10 == 9), guard.document["state"]
        seen = look.cam_from_target @ exp(np.eye(6)[at % 3] * np.deg2rad(deg))
        assert guard.update(replace(look, cam_from_target=seen)).holds
        if deg:
            after = guard.document["state"]
            for name in ("shape", "fresh", "slow", "offsets", "stood", "usual"):
                assert after[name] == before[name]


def test_a_look_that_cannot_be_used_is_refused_and_changes_nothing():
    place = usual("eye-in-hand")
    guard, cell = Guard(place.calibration), place.cell
    (look,) = looks(place, np.random.default_rng(2), 1, start=5)
    guard.update(look)
    before, bad = guard.document, look.corners.take(np.arange(3))
    strange, px = replace(look.corners, ids=look.corners.ids + 900), look.corners.px.copy()
    # Its square is no number.
    px[2, 0] = 1e200
    afar = replace(look.corners, px=px)
    for changed, words in (
        ({"time_s": 1.0}, "earlier than the last, at 18000 s"),
        ({"joints_rad": None}, "no joints_rad"),
        ({"joints_rad": np.zeros(3)}, "must be 6"),
        ({"joints_rad": np.rad2deg(look.joints_rad)}, "in degrees by its size"),
        ({"corners": bad}, "its 3 corners do not determine"),
        ({"corners": afar}, r"at \(1e\+200, .*\) px lies far outside the calibrated"),
        ({"corners": strange}, "corners do not determine"),
        ({"target": "other"}, "its target is 'other'"),
    ):
        raised(DataError, words, lambda c=changed: guard.update(replace(look, **c)))
    pose = cell.cam_from_target[0]
    far = pose.copy()
    far[:3, 3] *= 1e3
    for changed, words in (
        ({"cam_from_target": pose}, "one of the two"),
        ({"corners": None}, "one of the two"),
        ({"corners": None, "cam_from_target": far}, "millimetres"),
        ({"base_from_flange": np.eye(3)}, "its shape is"),
        ({"time_s": np.nan}, "time_s is nan, but must be seconds"),
        # Nanoseconds: after them all looks in seconds would be too early.
        ({"time_s": 1.8e18}, "time_s is 1.8e"),
    ):
        raised(DataError, words, lambda c=changed: replace(look, **c))
    assert guard.document == before
    wide, state = np.array(before["state"]["covariance"]), before["state"]
    damaged = [{**before, "calibration": "x"}, {"calibration": before["calibration"]}]
    # With these the next look's covariance is none, or its evidence no number.
    damaged += [{**before, "state": {**state, "covariance": (-wide).tolist()}}]
    damaged += [{**before, "state": {**state, "mean": state["mean"][:-1]}}]
    for document in damaged:
        raised(DataError, "cannot be used", guard.restore, document)
    for wrong, words in (({"false_alarm_looks": 1.0}, "100 to"), ({"slow_mm": -1.0}, "0 to 10")):
        raised(DataError, f"must be a number from {words}", Guard, place.calibration, **wrong)
    without = replace(place.calibration, joint_fit=None)
    raised(DataError, "holds no fit", Guard, without)


def test_mistakes_at_the_command_line_are_refused(tmp_path, monkeypatch):
    place, rng = usual("eye-in-hand"), np.random.default_rng(4)
    place.calibration.save(tmp_path / "calibration.json")
    against = ("--against", tmp_path, "--state", tmp_path / "state.json")

    def sent(*lines):
        # A lone surrogate is a byte that is no text.
        typed = "".join(f"{line}\n" for line in lines).encode(errors="surrogateescape")
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(typed), encoding="ascii"))
        done = visioncal("guard", *against)
        return done.status, [json.loads(line) for line in done.out.splitlines()]

    def seen(count, start, change=None):
        for look in looks(place, rng, count, change, start):
            corners = np.column_stack([look.corners.ids, look.corners.px]).tolist()
            pose = look.base_from_flange.tolist()
            line = {"time_s": look.time_s, "base_from_flange": pose, "corners": corners}
            yield json.dumps({**line, "joints_rad": look.joints_rad.tolist()})

    status, said = sent(*seen(20, 0))
    assert (status, said[-1]["look"], said[-1]["holds"]) == (0, 20, True)
    wrong = {
        "{": "not JSON",
        '{"time_s": 1, "target": "\udcff"': "not JSON",
        '{"time_s": 1}': "cam_from_target or",
        '{"when": 2}': "'when'",
        '{"acknowledge": false}': "or acknowledge alone, true",
        "null": "line 7: the look is null, but must be a JSON object",
        "[" * 9999: "nested deeper",
        '{"time_s": null}': "no time_s",
        '{"time_s": [1]}': "time_s is [1]; it has to be a number of seconds",
        '{"time_s": 1, "corners": 3}': "corners is 3; it has to be a list of [number, x, y]",
        '{"time_s": 1, "corners": [[1, 2, 3], [1, 4, 5]]}': "each whole number once",
        '{"time_s": 1, "corners": [[0.5, 2, 3]]}': "each whole number once",
        '{"time_s": 1, "joints_rad": ["a"]}': 'joints_rad is ["a"]; it has to be a list',
        '{"time_s": 1, "base_from_flange": {}}': "base_from_flange is {}; it has to be a 4 x 4",
    }
    status, said = sent("", *wrong, *seen(1, 20))
    assert (status, said[-1]["look"]) == (2, 21)
    for answer, words in zip(said[:-1], wrong.values(), strict=True):
        error = answer["error"]
        assert words in error["message"]
        assert not error["next"] or error["next"] not in error["message"]
    status, said = sent(*seen(30, 21, Change(camera=knock(rng, 2.0, 0.2))))
    assert (status, said[-1]["holds"], said[-1]["causes"][0]["cause"]) == (3, False, "camera")
    status, said = sent('{"acknowledge": true}')
    assert (status, said) == (0, [{"acknowledged": True}])
    for damaged in ("", "{", "[]", "{}"):
        (tmp_path / "state.json").write_text(damaged)
        refused = visioncal("guard", *against).refused("Delete it, if it is the guard's")
        assert "Correct" not in refused.err


TURNS_DEG = np.array([[0.02, 0.01, 0.0], [-0.1, 0.3, 0.4], [0.05, -0.06, -0.2]])
DOCUMENT = """schema = 1
name = "{}"
mount = "eye-in-hand"
target = "charuco_9x6_30mm"
[camera]
resolution = [480, 360]
"""
TABLE = "view,image,x_m,y_m,z_m,qx,qy,qz,qw\n"


@pytest.fixture(scope="module")
def lights():
    """The light of three scenes, before and after each has turned."""
    pairs = [(np.zeros(3), turn) for turn in TURNS_DEG]
    return [[Scene(seed).light(turned(at)) for at in pair] for seed, pair in enumerate(pairs)]


@pytest.mark.slow
def test_turns_are_within_their_covariance(lights):
    """In other light; where parts move; with the camera's offset over a plane."""
    squares, rng = [], np.random.default_rng(0)
    for covered in (0.0, 0.3):
        for (before, now), turn in zip(lights, TURNS_DEG, strict=True):
            reference = disturbed(before, rng, covered, (1.0, 1.0))
            found = register(reference, disturbed(now, rng, covered), CAMERA)
            assert not found.reason
            error = found.turn - np.deg2rad(turn)
            # Hundredths of a pixel: hundreds of patches of a twentieth each.
            assert np.abs(error).max() * CAMERA.matrix[0] < 0.06
            squares.append(error @ np.linalg.solve(found.covariance, error))
    # The interval of a chi-square of 18 degrees of freedom that 1 in 1000 leaves.
    assert 4.4 < sum(squares) < 43.0
    offset, plane = np.array([0.002, -0.001, 0.003]), np.array([0.0, 0.0, 1.0, 1.0])
    poses = turned(np.zeros(3)), turned(TURNS_DEG[1], offset)
    images = [disturbed(Scene(3, flat=True).light(pose), rng) for pose in poses]
    found = register(*images, CAMERA, None, plane)
    error = found.turn - np.append(np.deg2rad(TURNS_DEG[1]), offset)
    # Of six degrees of freedom.
    assert error @ np.linalg.solve(found.covariance, error) < 22.5


def test_images_without_information_are_named(lights):
    """None is a shift by accident."""
    rng = np.random.default_rng(1)
    reference = disturbed(lights[0][0], rng, 0.0, (1.0, 1.0))
    columns = np.arange(reference.shape[1])
    for words, image in (
        ("another scene", disturbed(lights[1][0], rng)),
        ("another scene", rng.integers(0, 255, reference.shape).astype(np.uint8)),
        ("blurred", cv2.GaussianBlur(reference, (0, 0), 8.0)),
        ("black, white or even", np.zeros_like(reference)),
        ("has 360 x 480 px, the camera 480 x 360", reference.T.copy()),
        ("stand still while", np.where(columns < 300, np.roll(reference, 7, axis=1), reference)),
    ):
        found = register(reference, image, CAMERA)
        assert words in found.reason
        assert np.isnan(found.turn).all()
    masked = register(reference, reference, CAMERA, np.zeros(reference.shape, bool))
    assert "too little texture" in masked.reason
    # What the mask leaves out may do anything.
    still = np.broadcast_to(columns >= 320, reference.shape)
    moving = np.where(still, reference, np.roll(reference, 7, axis=1))
    assert np.abs(register(reference, moving, CAMERA, still).shift_px).max() < 0.01


def test_no_single_look_is_an_alarm_and_shifts_are():
    rng = np.random.default_rng(2)
    watches = [SceneWatch(np.ones(3), 0.1, 10_000.0) for _ in range(3)]
    for look in range(60):
        noise = 0.1 * rng.normal(size=3)
        # Wrong by far once in ten looks, in any direction; shifted by 1 px from look 50 on.
        wrong = 50.0 * rng.normal(size=3) * (look % 10 == 9)
        shift = np.array([0.8, 0.0, 0.6]) * (look >= 50)
        for watch, other in zip(watches, (0.0, wrong, shift), strict=True):
            watch.update(look % 2, noise + other, 1e-4 * np.eye(3))
        assert [watch.holds for watch in watches] == [True, True, look < 52]


def test_the_boards_plane_is_where_it_stands():
    place = usual("eye-in-hand")
    pose = place.cell.robot.base_from_flange[4]
    numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
    view = View(4, numbers=dict(zip(POSE, numbers, strict=True)))
    plane = scene_plane(place.calibration, view, "board")
    cam_from_target = place.cell.cam_from_target[4]
    # As well as it is calibrated.
    np.testing.assert_allclose(plane[:3], cam_from_target[:3, 2], atol=2e-3)
    np.testing.assert_allclose(plane[3], plane[:3] @ cam_from_target[:3, 3], atol=1e-3)


def test_a_session_is_audited_by_the_command_line(tmp_path, lights):
    """A session is audited by poses that it shows again."""
    calibration = usual("eye-in-hand").calibration
    lens = replace(calibration.camera, camera=CAMERA, field=None)
    replace(calibration, camera=lens).save(tmp_path / "calibration.json")
    rng = np.random.default_rng(3)

    def audited(name, numbers, *options):
        """Answers to views of scenes at two poses; the camera has turned in those from 100 on."""
        folder, rows = tmp_path / name, TABLE
        (folder / "images").mkdir(parents=True)
        for at, number in enumerate(numbers):
            light = lights[1 if number % 2 else 2][number >= 100]
            cv2.imwrite(str(folder / f"images/{at}.png"), disturbed(light, rng, 0.1))
            rows += f"{at},images/{at}.png,{0.1 * (number % 2)},0,0.5,0,0,0,1\n"
        (folder / "views.csv").write_text(rows)
        (folder / "session.toml").write_text(DOCUMENT.format(name))
        done = visioncal("guard", "--scene", folder, "--against", tmp_path, *options)
        return done, [json.loads(line) for line in done.out.splitlines()]

    done, said = audited("still", [0, 1, 0, 1, 0, 1])
    assert [look["reference"] for look in done.good() and said] == [0, 1, 0, 1, 0, 1]
    done, said = audited("turned", [1, 1, 1, 101, 101, 101, 101], "--plane", "1200")
    assert (done.status, said[2]["holds"], said[-1]["holds"]) == (3, True, False)
    assert {"offset_mm", "sigma_mm"} < said[-1].keys()
    audited("few", [0, 1, 0])[0].refused("could be compared with an earlier one")
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((10, 20), 255, np.uint8))
    audited("masked", [0], "--mask", tmp_path / "mask.png")[0].refused("20 x 10 px")
    audited("flat", [0], "--plane", "floor")[0].refused("board, or a distance in mm")
