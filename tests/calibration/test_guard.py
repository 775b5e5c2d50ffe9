"""The guard: rows of a look, false alarms, what it names, what it keeps, what it refuses."""

import io
import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from support.commands import visioncal
from support.later import FITTED, Change, again, knock, usual
from support.refusals import raised

from visioncal import Guard, Look
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp

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


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_rows_of_a_look_are_what_changes_of_the_cell_do_to_it(mount):
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


def test_false_alarms_are_as_rare_as_stated():
    guard = Guard(usual("eye-in-hand").calibration, false_alarm_looks=100.0)
    rng, alarms, count = np.random.default_rng(0), 0, 3000
    shown = [guard.rows(look) for look in looks(usual("eye-in-hand"), rng, 12)]
    for at in range(count):
        # One look of 50 is wrong, by a hundred times its noise.
        factor = 100.0 if rng.random() < 0.02 else 1.0
        if not guard.take(white(shown[at % 12], rng, HOUR_S * at, factor)).holds:
            alarms += 1
            guard.acknowledge()
    # 30 in the mean; beyond four sigma of Poisson's distribution above. While noise is learned
    # there are fewer.
    assert 3 <= alarms <= 30 + 4 * np.sqrt(30)


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_change_is_named_with_its_size_and_time(mount):
    place, rng, learned = usual(mount), np.random.default_rng(1), 120
    guard = Guard(place.calibration)
    for look in looks(place, rng, learned):
        assert guard.update(look).holds
    kept = json.loads(json.dumps(guard.document))
    changes = {
        "camera": Change(camera=knock(rng, 0.6, 0.06)),
        "board": Change(board=knock(rng, 0.6, 0.06)),
        "joint 3": Change(joints_rad=np.array([0.0, 0.0, 1e-3, 0.0, 0.0, 0.0])),
    }
    for name, change in changes.items():
        found = [guard.restore(kept).update(look) for look in looks(place, rng, 1, change, learned)]
        found += [guard.update(look) for look in looks(place, rng, 24, change, learned + 1)]
        late = [answer.holds for answer in found].index(False)
        last = found[-1]
        best = last.causes[0]
        # Shifts of several sigma of a look, in noise as it is stated until it is learned.
        assert late < 12, name
        assert best.cause == name
        assert best.probability > 0.9
        assert sum(cause.probability for cause in last.causes) == pytest.approx(1.0)
        after, by = last.changed_s
        assert after <= HOUR_S * learned
        assert by >= HOUR_S * learned
        size, sigma = (best.deg, best.sigma_deg) if "joint" in name else (best.mm, best.sigma_mm)
        true = np.rad2deg(1e-3) if "joint" in name else 0.6
        # What is estimated of a length has a bias of its sigma at most.
        assert abs(size - true) < 5.0 * sigma + 0.1 * true
        # What is learned is kept through a restart to the last bit.
        again_ = Guard(place.calibration).restore(json.loads(json.dumps(guard.document)))
        (look,) = looks(place, rng, 1, change, learned + 40)
        assert again_.update(look) == guard.update(look)


def test_a_look_that_cannot_be_used_is_refused_and_changes_nothing():
    place = usual("eye-in-hand")
    guard, cell = Guard(place.calibration), place.cell
    (look,) = looks(place, np.random.default_rng(2), 1, start=5)
    guard.update(look)
    before, bad = guard.document, look.corners.take(np.arange(3))
    strange = replace(look.corners, ids=look.corners.ids + 900)
    for changed, words in (
        ({"time_s": 1.0}, "earlier than the last, at 18000 s"),
        ({"joints_rad": None}, "no joints_rad"),
        ({"joints_rad": np.zeros(3)}, "6 are needed"),
        ({"corners": bad}, "its 3 corners do not determine"),
        ({"corners": strange}, "corners do not determine"),
        ({"target": "other"}, "its target is 'other'"),
    ):
        raised(DataError, words, lambda c=changed: guard.update(replace(look, **c)))
    pose = cell.cam_from_target[0]
    far = pose.copy()
    far[:3, 3] *= 1e3
    for changed, words in (
        ({"cam_from_target": pose}, "one of both"),
        ({"corners": None}, "one of both"),
        ({"corners": None, "cam_from_target": far}, "millimetres"),
        ({"base_from_flange": np.eye(3)}, "its shape is"),
        ({"time_s": np.nan}, "its time is nan"),
    ):
        raised(DataError, words, lambda c=changed: replace(look, **c))
    assert guard.document == before
    for damaged in ({**before, "calibration": "x"}, {"calibration": before["calibration"]}):
        raised(DataError, "cannot be used", guard.restore, damaged)
    for wrong in ({"false_alarm_looks": 1.0}, {"slow_mm": -1.0}):
        raised(DataError, "are needed", Guard, place.calibration, **wrong)
    without = replace(place.calibration, joint_fit=None)
    raised(DataError, "holds no fit", Guard, without)


def test_of_the_command_line(tmp_path, monkeypatch):
    place, rng = usual("eye-in-hand"), np.random.default_rng(4)
    place.calibration.save(tmp_path / "calibration.json")
    against = ("--against", tmp_path, "--state", tmp_path / "state.json")

    def sent(*lines):
        monkeypatch.setattr(sys, "stdin", io.StringIO("".join(f"{line}\n" for line in lines)))
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
    status, said = sent("{", "", '{"time_s": 1}', '{"when": 2}', "[]", "[" * 9999, *seen(1, 20))
    assert (status, said[-1]["look"]) == (2, 21)
    wrong = ("no JSON", "cam_from_target or", "'when'", "is list", "nested deeper")
    for answer, words in zip(said, wrong, strict=False):
        assert words in answer["error"]["message"]
    status, said = sent(*seen(30, 21, Change(camera=knock(rng, 2.0, 0.2))))
    assert (status, said[-1]["holds"], said[-1]["causes"][0]["cause"]) == (3, False, "camera")
    status, said = sent('{"acknowledge": true}')
    assert (status, said) == (0, [{"acknowledged": True}])
