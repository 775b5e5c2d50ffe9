"""Simulated readings of an instrument: an arm that is wrong, a tracker beside it, a tool.

Written with the simulation's own kinematics, so that the estimator is not judged with its own.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.pipeline.known import Known
from visioncal.pipeline.steps import STAGES
from visioncal.session import MemoryImages, Session
from visioncal.simulation.arms import Arm, ArmErrors, arm_named, disturb, forward, link_frames
from visioncal.simulation.records import load_row
from visioncal.simulation.sag import Payload, giving_of, sagging
from visioncal.transforms import compose, exp, invert, log
from visioncal.types import FloatArray

POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class Tracked:
    """What a session is drawn from.

    Attributes:
        robot: Its name.
        stops: How many.
        points: Places of the points on the flange [m]; one alone where poses are read.
        poses: Whether the first point is a probe whose rotation is read, too.
        sigma_m: Noise of a coordinate [m].
        sigma_rad: Noise of a probe's rotation [rad].
        robot_sigma_m: Repeatability of the flange [m].
        robot_sigma_rad: The same of its rotation [rad].
        dh_sigma_m: Errors of the arm's lengths [m].
        dh_sigma_rad: Errors of its angles [rad].
        compliance: What each joint yields to a torque [rad/(N m)]; empty for a rigid arm.
        payloads: What hangs on the flange, stop by stop in turn.
        seed: Of everything random.
    """

    robot: str = "ur10e"
    stops: int = 30
    points: tuple[tuple[float, float, float], ...] = ((0.03, -0.02, 0.12),)
    poses: bool = False
    sigma_m: float = 2e-5
    sigma_rad: float = 5e-5
    robot_sigma_m: float = 3e-5
    robot_sigma_rad: float = 3e-5
    dh_sigma_m: float = 0.0
    dh_sigma_rad: float = 0.0
    compliance: tuple[float, ...] = ()
    payloads: tuple[Payload, ...] = ()
    seed: int = 0


THREE = ((0.03, -0.02, 0.12), (0.10, 0.05, 0.08), (-0.08, 0.06, 0.10))


@dataclass(frozen=True, eq=False)
class Shop:
    """The truth and what was read.

    Attributes:
        options: What it was drawn from.
        arm: The nominal arm.
        true_arm: The real one.
        base_from_instrument: (4, 4).
        flange_from_probe: (4, 4); the first point's place, without a turn where places are read.
        joints: (s, n) [rad].
        rows: Each reading's stop, point, and (4, 4) pose in the instrument's frame.
    """

    options: Tracked
    arm: Arm
    true_arm: Arm
    base_from_instrument: FloatArray
    flange_from_probe: FloatArray
    joints: FloatArray
    rows: tuple[tuple[int, int, FloatArray], ...]


def tracked(options: Tracked, joints: FloatArray | None = None) -> Shop:
    rng = np.random.default_rng([7, options.seed])
    arm = arm_named(options.robot)
    errors = ArmErrors(options.dh_sigma_m, options.dh_sigma_rad, options.dh_sigma_rad)
    true_arm = disturb(arm, errors, rng)
    x = compose(exp(np.array([[0.1, -0.2, 2.5, 0, 0, 0]]))[0, :3, :3], np.array([2.5, -1.0, 0.4]))
    turn = exp(np.array([[0.5, 1.0, -0.3, 0, 0, 0]]))[0, :3, :3] if options.poses else np.eye(3)
    z = compose(turn, np.array(options.points[0]))
    if joints is None:
        joints = above(arm, options.stops, rng)
    sigmas = np.repeat([options.robot_sigma_rad, options.robot_sigma_m], 3)
    giving = giving_of(true_arm, options.compliance, 1.0, ())
    standing = sagging(true_arm, giving, joints, payloads_of(options, len(joints)))
    flange = forward(true_arm, standing) @ exp(rng.normal(size=(len(joints), 6)) * sigmas)
    rows = []
    for stop, pose in enumerate(flange):
        for point, place in enumerate(options.points):
            on_flange = z if point == 0 else compose(np.eye(3), np.array(place))
            true = invert(x) @ pose @ on_flange
            turned = exp(np.r_[rng.normal(size=3) * options.sigma_rad, 0, 0, 0][None])[0, :3, :3]
            place_read = true[:3, 3] + options.sigma_m * rng.normal(size=3)
            rows.append((stop, point, compose(true[:3, :3] @ turned, place_read)))
    return Shop(options, arm, true_arm, x, z, joints, tuple(rows))


def payloads_of(options: Tracked, stops: int) -> list[Payload]:
    """What hung on the flange at each stop; empty for nothing."""
    hung = options.payloads
    return [hung[at % len(hung)] for at in range(stops)] if hung else []


def above(arm: Arm, stops: int, rng: np.random.Generator) -> FloatArray:
    """Postures all over the workspace, above the table [rad]."""
    kept = []
    while len(kept) < stops:
        q = rng.uniform(-2.5, 2.5, (1, len(arm.offset)))
        if forward(arm, q)[0, 2, 3] > 0.1:
            kept.append(q[0])
    return np.array(kept)


def session_of(shop: Shop, *, joints: bool = True, poses: bool = False, **document) -> Session:
    """The session as it stands in memory.

    Args:
        shop: What was read.
        joints: Whether rows have joint angles and the session names the robot.
        poses: Whether rows have the nominal arm's poses.
        document: Tables of session.toml, in the place of the right ones.
    """
    options = shop.options
    columns = ["view", "stop", "point", "meas_x_m", "meas_y_m", "meas_z_m"]
    columns += [f"meas_{it}" for it in POSE[3:]] * options.poses
    columns += list(POSE) * poses + [f"q{it + 1}_rad" for it in range(6)] * joints
    payloads = payloads_of(options, len(shop.joints))
    columns += list(load_row(payloads[0])) if payloads else []
    nominal = forward(shop.arm, shop.joints)
    cells = []
    for view, (stop, point, read) in enumerate(shop.rows):
        row = [view, stop, "abc"[point] if len(options.points) > 1 else "", *read[:3, 3]]
        row += [*_quaternion(read)] * options.poses
        row += [*nominal[stop, :3, 3], *_quaternion(nominal[stop])] * poses
        row += [*shop.joints[stop]] * joints
        row += [*load_row(payloads[stop]).values()] if payloads else []
        cells.append([repr(float(it)) if isinstance(it, float) else str(it) for it in row])
    noise = {"sigma_m": options.sigma_m}
    if options.poses:
        noise["sigma_rad"] = options.sigma_rad
    facts = {"schema": 1, "name": "tracked", "instrument": noise}
    facts |= {"robot": {"model": options.robot}} if joints else {}
    return Session.assemble(facts | document, columns, cells, MemoryImages({}))


def _quaternion(pose: FloatArray) -> FloatArray:
    return Rotation.from_matrix(pose[:3, :3]).as_quat()


def known_of(session: Session, **changes) -> Known:
    """What is known at the end of the way."""
    known = replace(Known(session, "joint"), **changes)
    for stage in STAGES:
        known = stage.run(known)
    return known


def errors_of(shop: Shop, known: Known) -> FloatArray:
    """(12,) right perturbations of both edges, true to estimated (rotation, translation)."""
    edges = known.solved.edges
    return np.concatenate(
        [
            log(invert(shop.base_from_instrument) @ edges.x),
            log(invert(shop.flange_from_probe) @ edges.z),
        ]
    )


def solved_of(session: Session, **changes) -> Known:
    """What is known once both edges are, with the nominal arm unless a `level` is asked for."""
    known = replace(Known(session, "joint"), **({"level": "hand-eye"} | changes))
    for stage in STAGES:
        known = stage.run(known)
        if stage.name == "hand-eye":
            break
    return known


def information(shop: Shop, arm_columns: bool = False) -> FloatArray:
    """Fisher information of what is read, by central differences of the simulation's own chain.

    Unknown are the instrument's frame (6), the probe's (6), each further point's place (3), and the
    twists of the links (6 each) where `arm_columns`. The noise is known, the flange's errors are
    one a stop.
    """
    options = shop.options
    size = 12 + 3 * (len(options.points) - 1) + 36 * arm_columns
    steps = 1e-5 * np.eye(size)
    slopes = np.stack([(reads(shop, it) - reads(shop, -it)) / 2e-5 for it in steps], axis=-1)
    slack = 1e-5 * np.eye(6)
    nothing = np.zeros(size)
    by_flange = np.stack(
        [(reads(shop, nothing, it) - reads(shop, nothing, -it)) / 2e-5 for it in slack], axis=-1
    )
    sigmas = np.full(slopes.shape[1], options.sigma_m)
    if options.poses:
        sigmas[:3] = options.sigma_rad
    repeats = np.repeat([options.robot_sigma_rad, options.robot_sigma_m], 3) ** 2
    total = np.zeros((size, size))
    for slope, moved in zip(slopes, by_flange, strict=True):
        spread = np.diag(sigmas**2) + (moved * repeats) @ moved.T
        total += slope.T @ np.linalg.solve(spread, slope)
    return total


def reads(
    shop: Shop, change: FloatArray, slack: FloatArray | None = None, q: FloatArray | None = None
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


def mounting_bound(shop: Shop) -> FloatArray:
    """Least covariance of x (6) and z (6); of z's place alone (3) where places are read."""
    kept = np.arange(12) if shop.options.poses else np.r_[:6, 9:12]
    whole = information(shop)
    rows = np.r_[kept, 12 : len(whole)]
    return np.linalg.inv(whole[np.ix_(rows, rows)])[: len(kept), : len(kept)]
