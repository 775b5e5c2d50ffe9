"""What simulated readings of an instrument should give, and at best can.

Written with the simulation's own kinematics, so that the estimator is not judged with its own.
"""

from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES
from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import FloatArray
from visioncal.session import Session
from visioncal.simulation.arms import forward, link_frames
from visioncal.simulation.instrument_session import InstrumentRecord


def known_of(session: Session, **changes) -> RunState:
    """What is known at the end of the way."""
    known = replace(RunState(session), **changes)
    for stage in STAGES:
        known = stage.run(known)
    return known


def errors_of(shop: InstrumentRecord, known: RunState) -> FloatArray:
    """(12,) right perturbations of both edges, true to estimated (rotation, translation)."""
    true = np.array([shop.base_from_instrument, shop.flange_from_probe])
    return log(invert(true) @ known.assessment.state.edges[:2]).ravel()


def solved_of(session: Session, **changes) -> RunState:
    """What is known once both edges are, with the nominal arm unless a `level` is asked for."""
    known = replace(RunState(session), **({"level": "hand-eye"} | changes))
    for stage in STAGES:
        known = stage.run(known)
    return known


def information(shop: InstrumentRecord, arm_columns: bool = False) -> FloatArray:
    """Fisher information of what is read, by central differences of the simulation's own chain.

    Unknown are the instrument's frame (6), the probe's (6), each further point's place (3), and the
    twists of the links (6 each) where `arm_columns`. The noise is known, the flange's errors are
    one a stop.
    """
    options = shop.options
    size = 12 + 3 * (len(options.points) - 1) + 36 * arm_columns
    steps = 1e-5 * np.eye(size)
    jacobian = np.stack(
        [(reads(shop, step) - reads(shop, -step)) / 2e-5 for step in steps], axis=-1
    )
    slack = 1e-5 * np.eye(6)
    nothing = np.zeros(size)
    flange_jacobian = np.stack(
        [(reads(shop, nothing, value) - reads(shop, nothing, -value)) / 2e-5 for value in slack],
        axis=-1,
    )
    sigmas = np.full(jacobian.shape[1], options.sigma_m)
    if options.poses:
        sigmas[:3] = options.sigma_rad
    repeats = np.repeat([options.robot_sigma_rad, options.robot_sigma_m], 3) ** 2
    total = np.zeros((size, size))
    for slope, moved in zip(jacobian, flange_jacobian, strict=True):
        covariance = np.diag(sigmas**2) + (moved * repeats) @ moved.T
        total += slope.T @ np.linalg.solve(covariance, slope)
    return total


def reads(
    shop: InstrumentRecord,
    change: FloatArray,
    slack: FloatArray | None = None,
    q: FloatArray | None = None,
) -> FloatArray:
    """What is read at each stop, (s, r), when the unknowns of `information` change.

    Args:
        shop: The truth.
        change: The unknowns' steps.
        slack: (6,) an error of the flange.
        q: (s, n) other stops [rad].
    """
    options, points = shop.options, len(shop.options.points)
    frames = link_frames(shop.true_arm, shop.joints if q is None else q)
    links = np.zeros((6, 6))
    links.flat[: max(len(change) - 9 - 3 * points, 0)] = change[9 + 3 * points :]
    flange = np.broadcast_to(np.eye(4), (len(frames), 4, 4))
    for joint in range(6):
        link = invert(frames[:, joint]) @ frames[:, joint + 1]
        flange = flange @ link @ exp(links[None, joint])[0]
    if slack is not None:
        flange = flange @ exp(slack[None])[0]
    x = shop.base_from_instrument @ exp(change[None, :6])[0]
    z = shop.flange_from_probe @ exp(change[None, 6:12])[0]
    from_instrument = invert(x) @ flange
    probe = from_instrument @ z
    places = [probe[:, :3, 3]]
    for point in range(1, points):
        moved = np.array(options.points[point]) + change[9 + 3 * point : 12 + 3 * point]
        places.append(from_instrument[:, :3, :3] @ moved + from_instrument[:, :3, 3])
    if not options.poses:
        return np.concatenate(places, axis=1)
    true = invert(shop.base_from_instrument) @ forward(
        shop.true_arm, shop.joints if q is None else q
    )
    turned = log(invert(true @ shop.flange_from_probe) @ probe)[:, :3]
    return np.concatenate([turned, *places], axis=1)


def mounting_bound(shop: InstrumentRecord) -> FloatArray:
    """Least covariance of x (6) and z (6); of z's place alone (3) where places are read."""
    kept = np.arange(12) if shop.options.poses else np.r_[:6, 9:12]
    whole = information(shop)
    rows = np.r_[kept, 12 : len(whole)]
    return np.linalg.inv(whole[np.ix_(rows, rows)])[: len(kept), : len(kept)]
