"""A calibration after a knock: what changed and what was kept, the proof, the act in its folder."""

from dataclasses import replace

import numpy as np
import pytest
from support.commands import visioncal
from support.later import Change, again, knock, known_again, usual

from visioncal.calibration.recovery import causes_found, changed, moved_along, parted, recover
from visioncal.calibration.verification import verify
from visioncal.calibration.verification.calibration_prior import CalibrationPrior
from visioncal.calibration.verification.check import check
from visioncal.calibration.verification.prediction import predict_detected
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert, log
from visioncal.results import Calibration
from visioncal.simulation import cell_session, read_truth

STOPS = 10


@pytest.fixture(scope="module", params=["eye-in-hand", "eye-to-hand"])
def place(request):
    return usual(request.param)


def recovered(place, change, rng, causes=None):
    known = known_again(place.cell, rng, change, STOPS)
    prior = CalibrationPrior.of(place.calibration)
    found = check(predict_detected(known, prior), prior)
    causes = causes or causes_found(found)
    return causes, changed(found, causes, place.calibration.rms)[0]


@pytest.mark.parametrize("kind", ["camera", "board", "camera and board", "joint 3"])
def test_what_changed_is_estimated_with_its_covariance_and_the_rest_is_kept(place, kind):
    rng, old, squares = np.random.default_rng(7), place.calibration, []
    (x, z), q = place.cell.transforms.values(), place.cell.robot.joints
    for _ in range(3):
        change = Change(
            camera=knock(rng, 30.0, 10.0) * ("camera" in kind),
            board=knock(rng, 10.0, 3.0) * ("board" in kind),
            joints_rad=np.deg2rad(0.5) * np.eye(6)[2] * (kind == "joint 3"),
        )
        causes, found = recovered(place, change, rng)
        assert causes == tuple(kind.split(" and "))
        new = Calibration.from_json(found.text, "recovered")
        truth = (x @ exp(change.camera), z @ exp(change.board))
        # Errors of what changed, beyond those that the old calibration had and keeps.
        for name, moved, before, after in zip(
            ("camera", "board"), truth, old.edges.values(), new.edges.values(), strict=True
        ):
            if name not in causes:
                assert np.array_equal(before.matrix, after.matrix)
                continue
            away = log(invert(moved) @ after.matrix)
            squares.append(away @ np.linalg.solve(after.covariance, away) / 6)
        if kind == "joint 3":
            errors = [
                log(invert(place.cell.robot.flange_at(q + offset)) @ arm.standing(q))[:, 3:]
                for arm, offset in ((old, 0.0), (new, change.joints_rad))
            ]
            before_m, after_m = (np.sqrt(np.mean(error**2)) for error in errors)
            # One angle from ten stops adds little to the errors of an arm of 36 parameters.
            squares.append(after_m / before_m)
            assert after_m < 1.1 * before_m
    # Errors of three knocks are correlated by those of the old calibration, which is one draw: a
    # chi-square of 6 over its freedom is below 3.7 in 999 of 1000.
    assert np.mean(squares) < 3.7
    # Another look at the recovered cell passes, and is predicted about as surely as before: the
    # errors of what is new compensate those of what was kept, and would else add to them.
    sigmas = []
    for calibration, later in ((old, None), (new, change)):
        prior = CalibrationPrior.of(calibration)
        seen = predict_detected(known_again(place.cell, np.random.default_rng(9), later), prior)
        assert check(seen, prior).passed
        linear = seen.problem.linear(prior.state)
        sigmas.append(np.sqrt(np.trace(linear.covariance(prior.covariance).sum(axis=0)[3:, 3:])))
    # Ten stops to forty: 1.03 to 1.3, and of two changes to 1.62; added up 1.5 to 2.6, and 2.9.
    assert sigmas[1] < (1.8 if " and " in kind else 1.45) * sigmas[0]


def test_targets_follow_a_base_or_a_mount_that_moved_with_all_on_its_side(place):
    rng, old = np.random.default_rng(1), place.calibration
    in_hand = old.mount == "eye-in-hand"
    change = Change(camera=knock(rng, 20.0, 5.0), board=knock(rng, 15.0, 2.0))
    causes, found = recovered(place, change, rng, ("base", "mount"))
    base_moved, flange_moved = moved_along(old, found, causes)
    on_flange, in_base = [*old.edges.values()][:: 1 if in_hand else -1]
    now = [*found.edges.values()][:: 1 if in_hand else -1]
    # A tool that stood at a fixed part stands there again.
    part, tool = exp(np.array([0.1, 0.2, 0.3, 0.0, 0.1, 0.1])), exp(np.full(6, 0.05))
    target = in_base.matrix @ part @ invert(on_flange.matrix @ tool)
    stands = base_moved @ target @ flange_moved @ now[0].matrix @ tool
    assert np.allclose(stands, now[1].matrix @ part, atol=1e-12)
    with pytest.raises(DataError, match="each motion once"):
        recovered(place, change, rng, ("base", "board" if in_hand else "camera"))
    with pytest.raises(DataError, match="what can be recovered here is camera"):
        recovered(place, change, rng, ("gripper",))


def test_stops_recorded_by_a_plan_of_the_calibrated_arm_are_verified_and_recovered_from():
    place, slip = usual("eye-in-hand"), Change(joints_rad=np.deg2rad(0.5) * np.eye(6)[2])
    stops, old = again(place.cell, np.random.default_rng(3), slip, 9), place.calibration
    session = cell_session(stops, "stops", seen="corners")
    planned = replace(session, robot_document=old.arm.robot.document)
    found = [verify(parted(each)[0], old) for each in (session, planned)]
    assert found[0].misfit == pytest.approx(found[1].misfit, rel=1e-6)
    new = recover(planned, old, ("joint 3",), found[1])
    assert "3 stops held back from a first estimate agree" in new.verdict.findings[0].words


def test_a_joint_is_to_be_mastered_where_its_angle_is_proven_and_nothing_else_changed(tmp_path):
    place, slip = usual("eye-in-hand"), Change(joints_rad=np.deg2rad(0.5) * np.eye(6)[2])
    stops, out = tmp_path / "my stops", tmp_path / "my out"
    fresh = again(place.cell, np.random.default_rng(3), slip, 9)
    cell_session(fresh, "stops", seen="corners").save(stops)
    out.mkdir()
    place.calibration.save(out / "calibration.json")
    act = ("recover", tmp_path / "act", "--against", out, "--stops", stops, "--count", 9)
    mastered = visioncal(*act).good().out
    assert f"Or master joint 3 on the controller, by the angle above: then {out} holds" in mastered
    assert "only where: The transforms belong to the calibrated arm" in mastered
    both = visioncal(*act, "--cause", "joint 3", "--cause", "camera").good().out
    assert "Or master" not in both
    unproven = visioncal(*act, "--cause", "joint 2")
    assert unproven.status == 3
    assert "disagree" in unproven.out
    assert "Or master" not in unproven.out


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """A calibrated cell, and later stops of it: as it was, and with the camera moved."""
    folder = tmp_path_factory.mktemp("knocked")
    of_cell = ("--robot", "ur5e", "--seed", 8, "--no-images")
    visioncal("simulate", folder / "cell", *of_cell, "--views", 20).good()
    visioncal("calibrate", folder / "cell", "-o", folder / "out", "--no-report").good()
    for number, (name, mm) in enumerate({"same": 0, "moved": 3, "more": 6}.items(), start=1):
        recording = ("--views", 15, "--recording", number, "--camera-moved-mm", mm)
        visioncal("simulate", folder / name, *of_cell, *recording).good()
    return folder


def test_an_act_is_ended_and_gone_on_with_at_each_step(cell, tmp_path):
    act, out, stops = tmp_path / "act", cell / "out", tmp_path / "act/stops"
    command = ("recover", act, "--against", out)
    begun = visioncal(*command)
    assert begun.status == 2
    assert f"visioncal record --arm manual --target BOARD --camera uvc:0 -o {stops}" in begun.err
    # The recording was cut off after nine stops, and is whole later.
    stops.mkdir()
    (stops / "session.toml").write_text((cell / "moved/session.toml").read_text())
    rows = (cell / "moved/views.csv").read_text().splitlines(keepends=True)
    (stops / "views.csv").write_text("".join(rows[:10]))
    visioncal(*command).refused("9 of 15 stops")
    (stops / "views.csv").write_text("".join(rows))
    asked = ("--targets", stops / "views.csv", "--to", "ur")
    visioncal(*command, *asked).refused("--cause camera\n", "--cause mount\n")
    assert not (act / "result").exists()
    done = visioncal(*command, *asked, "--cause", "camera", "--payload-kg", 3).good()
    assert "--payload-kg 3 changes nothing" in " ".join(done.err.split())
    assert "the camera moved by 3 mm" in done.out
    assert "minutes: plan" in done.out
    assert "5 stops held back from a first estimate agree" in done.out
    result = Calibration.load(act / "result")
    truth = read_truth(cell / "moved").transforms["flange_from_cam"]
    away = log(invert(truth) @ result.edges["flange_from_cam"].matrix)
    assert 1e3 * np.linalg.norm(away[3:]) < 3 * result.edges["flange_from_cam"].sigma_mm
    assert "p[" in (act / "exports/ur").read_text()
    assert len((act / "targets.csv").read_text().splitlines()) == len(rows)
    assert visioncal("verify", cell / "moved", "--against", act / "result").status == 0
    visioncal("recover", act, "--against", act / "result").refused("of another calibration")
    # Taught targets are not overwritten by what becomes of them.
    taught = (act / "targets.csv").read_text()
    over = visioncal(*command, "--targets", act / "targets.csv", "--cause", "camera")
    over.refused("where the converted targets are written")
    assert (act / "targets.csv").read_text() == taught


def test_an_act_ends_where_nothing_changed_and_where_the_proof_fails(cell, tmp_path):
    out = ("--against", cell / "out")
    same = visioncal("recover", tmp_path / "same", *out, "--stops", cell / "same").good()
    assert same.out.startswith("nothing has changed")
    assert not (tmp_path / "same/result").exists()
    # The stops that are held back come from after another knock.
    stops = tmp_path / "stops"
    stops.mkdir()
    (stops / "session.toml").write_text((cell / "moved/session.toml").read_text())
    rows = (cell / "moved/views.csv").read_text().splitlines(keepends=True)
    rows[3::3] = (cell / "more/views.csv").read_text().splitlines(keepends=True)[3::3]
    (stops / "views.csv").write_text("".join(rows))
    act = ("recover", tmp_path / "act", *out, "--stops", stops)
    failed = visioncal(*act, "--to", "ur")
    assert failed.status == 3
    assert "disagree" in failed.out
    assert not (tmp_path / "act/exports/ur").exists()
    visioncal(*act, "--to", "ur", "--force")
    assert (tmp_path / "act/exports/ur").exists()
