"""What `compare_worker.py` answers by the one likelihood of `visioncal.fit`, in place of commands.

It knows no verdict: each result is `good`. Fits stay in this process, by the folders of results.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

SOLVED = {}


def command(argv):
    """Fits a session in place of `calibrate SESSION -o OUT`, and writes what worlds judge."""
    from visioncal.core.errors import VisioncalError

    if argv[0] != "calibrate":
        return {"status": 1, "out": f"no command {argv[0]} by the one likelihood"}
    try:
        document = fitted(Path(argv[1]), Path(argv[3]))
    except VisioncalError as error:
        refusal = {"class": type(error).__name__, "message": str(error)}
        return {"status": 2, "out": json.dumps({"error": refusal})}
    return {"status": 0, "out": json.dumps(document)}


def fitted(path, out):
    """Fits a session; its document has the keys of calibration.json that worlds read."""
    from visioncal.calibration.stages.detect import detect
    from visioncal.fit.solve import solve
    from visioncal.model import read_cell
    from visioncal.session import Session

    session = Session.load(path)
    corners = dict(session.corners)
    if any(view.image and not view.has_corners for view in session.views):
        corners |= dict(detect(session).corners)
    session, sweeps = on_one_clock(session)
    solved = solve(read_cell(session, corners, sweeps))
    fit = solved.fit
    SOLVED[str(out / "calibration.json")] = fit
    tree = fit.cell.tree
    reference = next((name for name in tree.branches if tree.branches[name].known is not None), "")
    parents = {frame: tree.branches[frame].parent for frame in fit.cell.unknown}
    names = {
        frame: f"{reference if parent == 'cell' else parent}_from_{frame}"
        for frame, parent in parents.items()
    }
    document = {
        "reference": reference,
        "transforms": {name: {"matrix": fit.edge(at).tolist()} for at, name in names.items()},
        "joint_covariance": {
            "order": [*names.values()],
            "matrix": fit.covariance(*(("edge", frame) for frame in names)).tolist(),
        },
        "verdict": {"status": "good", "causes": []},
        "views": [
            {"view": sighting.view, "used": bool(used)}
            for sighting, used in zip(fit.cell.sightings, fit.used, strict=True)
        ]
        + [{"view": view, "used": False, "reason": why} for view, why in fit.cell.absent.items()],
        "effort": {
            "linearisations": solved.effort.linearisations,
            "likelihoods": solved.effort.likelihoods,
        },
    }
    if len(fit.unknowns.lenses) == 1:
        (camera,) = fit.unknowns.lenses
        values = fit.state.values["lens", camera]
        document["camera"] = {"matrix": values[:4].tolist(), "distortion": values[4:].tolist()}
    out.mkdir(parents=True, exist_ok=True)
    (out / "calibration.json").write_text(json.dumps(document))
    return document


def on_one_clock(session):
    """A session with the poses of robots at the times of its rows, and what was seen in motion."""
    from visioncal.calibration.run import STAGES, initial_state
    from visioncal.calibration.stages.clocks import waits_for_clock
    from visioncal.model import Swept
    from visioncal.session import frame_name

    if not waits_for_clock(session):
        return session, ()
    known = initial_state(session)
    for stage in STAGES[: [stage.name for stage in STAGES].index("clock") + 1]:
        known = stage.run(known)
    sweeps = [
        Swept(
            pair.camera,
            frame_name("flange", pair.robot),
            clocked.speeds,
            clocked.prior_sigma_s(erring=pair.robot in known.timed.robot_documents),
        )
        for pair, clocked in known.clocks.items()
        if clocked.speeds
    ]
    return known.timed, sweeps


def located(calibration, looks):
    """Places (3,) in the base and covariances of pixels, each on a plane of its own."""
    fit = SOLVED[calibration]
    (camera,) = fit.unknowns.lenses
    keys = [key for key in fit.unknowns.slices if key[1] == camera]
    keys += [("effect", effect.name) for effect in at_looks(fit, camera)]
    values, covariance = fit.state.values, fit.covariance(*keys)
    px_sigma = fit.sizes.get(f"px {camera}", 0.0)
    field = fit.unknowns.fields.get(camera)
    left = 0.0 if field is None else fit.sizes[f"field {camera}"] ** 2
    found = []
    for look in looks:
        spread = np.zeros((3, len(covariance)))
        centre, at = place(fit, camera, values, look), 0
        for key in keys:
            member = fit.unknowns[key]
            for column in range(member.count):
                # Of a unit: a radian, a metre, or what moves a corner by a pixel.
                step = 1e-4 * (np.arange(member.count) == column)
                moved = {**values, key: member.moved(values[key], step)}
                slope = (place(fit, camera, moved, look) - centre) / 1e-4
                spread[:, at] = slope / member.units[column]
                at += 1
        total = spread @ covariance @ spread.T
        for axis in range(2):
            step = 1e-3 * (np.arange(2) == axis)
            moved = {**look, "px": np.array(look["px"]) + step}
            slope = (place(fit, camera, values, moved) - centre) / 1e-3
            # Where no corner was seen, a field may be anything of its size.
            unseen = 0.0 if field is None else left * float(field.variance(moved["px"][None])[0])
            total += (px_sigma**2 + unseen) * np.outer(slope, slope)
        # A lens that focuses anew does so for this image, too.
        refocused = fit.sizes.get(f"focus jitter {camera}", 0.0)
        if refocused:
            grown = values["lens", camera].copy()
            grown[:2] *= 1.0 + 1e-6
            slope = (place(fit, camera, {**values, ("lens", camera): grown}, look) - centre) / 1e-6
            total += refocused**2 * np.outer(slope, slope)
        if look["pose"] is not None:
            from visioncal.core.transforms import exp

            for axis in range(6):
                name = "rad" if axis < 3 else "m"
                sigma = max(fit.sizes.get(f"{name} {arm}", 0.0) for arm in fit.cell.arms)
                pose = np.array(look["pose"]) @ exp(1e-6 * np.eye(6)[axis])
                slope = (place(fit, camera, values, {**look, "pose": pose}) - centre) / 1e-6
                total += sigma**2 * np.outer(slope, slope)
        found.append([centre.tolist(), total.tolist()])
    return {"status": 0, "out": found}


def arm(calibration, q, temperatures_c=None):
    """(m, 4, 4) poses of the only arm, at joint angles and, if given, temperatures."""
    from visioncal.fit.linearise import predicted
    from visioncal.model import Moments

    fit, q = SOLVED[calibration], np.array(q)
    ((flange, one),) = fit.cell.arms.items()
    heats = [effect for effect in fit.unknowns.effects if effect.kind == "heat"]
    if temperatures_c is not None and not heats:
        return {"status": 0, "out": "no drift"}
    poses, stops = {flange: one.model.base_from_flange(q)}, np.full(len(q), -1)
    base = fit.cell.tree.branches[flange].parent
    path, moments = (
        fit.cell.tree.path(base, flange),
        Moments(poses, {flange: q}, 0.0 * stops, stops),
    )
    cold = replace(
        fit.unknowns, effects=tuple(at for at in fit.unknowns.effects if at not in heats)
    )
    found = predicted(fit.cell, cold, fit.state, path, moments, {}).poses
    for heat in heats if temperatures_c is not None else ():
        values = fit.state.values["effect", heat.name]
        found = found @ heat.arm(values).motion(q, np.array(temperatures_c))
    return {"status": 0, "out": found.tolist()}


def at_looks(fit, camera):
    """Effects that act after the session: on a lens by distance, on a flange by its posture."""
    from visioncal.model.effects.posture import PostureEffect

    return [
        effect
        for effect in fit.unknowns.effects
        if isinstance(effect, PostureEffect)
        or (effect.frame == camera and effect.kind == "breathing")
    ]


def place(fit, camera, values, look):
    """(3,) where a pixel's ray meets its plane, in the base."""
    from visioncal.core.transforms import exp
    from visioncal.fit.unknowns import State
    from visioncal.model import Moments
    from visioncal.vision.camera import intrinsics, normalise, with_intrinsics

    lens, px = fit.unknowns.camera(State(values, {}), camera), np.array(look["px"])
    if camera in fit.unknowns.fields:
        px = px - fit.unknowns.fields[camera].moved(px[None], values["field", camera])[0]
    base_from_cam, pose = values["edge", camera], look["pose"]
    flanges = {name: np.array(pose)[None] for name in fit.cell.arms} if pose is not None else {}
    after = Moments(flanges, {}, np.zeros(1), np.full(1, -1))
    if pose is not None:
        twist = np.zeros(6)
        for effect in at_looks(fit, camera):
            if effect.place == "edge":
                twist += effect.twists(after, values["effect", effect.name])[0]
        base_from_cam = np.array(pose) @ exp(twist) @ base_from_cam
    point, normal = np.array(look["point"]), np.array(look["normal"])
    far = np.array([(np.linalg.inv(base_from_cam) @ np.append(point, 1.0))[2]])
    grown = intrinsics(lens)
    for effect in at_looks(fit, camera):
        if effect.place == "lens":
            grown = grown + effect.columns(after, far)[0] @ values["effect", effect.name]
    ray = np.append(normalise(with_intrinsics(lens, grown), px[None])[0], 1.0)
    origin, along = base_from_cam[:3, 3], base_from_cam[:3, :3] @ ray
    return origin + along * (normal @ (point - origin)) / (normal @ along)
