"""Simulated instrument readings: an imperfect arm with a tool, and a tracker beside it."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from visioncal.core.transforms import compose, exp, invert
from visioncal.core.types import FloatArray
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE, pose_row
from visioncal.simulation.arms import ArmOptions, DhArm, arm_named, drawn_postures, forward
from visioncal.simulation.records import CALIPER_M, write_truth


@dataclass(frozen=True, kw_only=True)
class InstrumentOptions(ArmOptions):
    """Options of a simulated session with an instrument."""

    stops: int = 30  # Number of stops.
    # Positions of the points on the flange [m]; a single one if poses are read.
    points: tuple[tuple[float, float, float], ...] = ((0.03, -0.02, 0.12),)
    poses: bool = False  # Whether the first point is a probe whose rotation is read as well.
    sigma_m: float = 2e-5  # Noise of a coordinate [m].
    sigma_rad: float = 5e-5  # Noise of a probe's rotation [rad].
    robot_sigma_rad: float = 3e-5
    seed: int = 0  # Seed of everything random.


THREE = ((0.03, -0.02, 0.12), (0.10, 0.05, 0.08), (-0.08, 0.06, 0.10))


@dataclass(frozen=True, eq=False)
class InstrumentRecord:
    """Ground truth and readings."""

    options: InstrumentOptions  # Options of the session.
    arm: DhArm  # Nominal arm.
    true_arm: DhArm  # Real arm.
    base_from_instrument: FloatArray  # (4, 4) pose of the instrument.
    # (4, 4) pose of the probe; the first point, without rotation, if only positions are read.
    flange_from_probe: FloatArray
    joints: FloatArray  # (s, n) joint angles [rad].
    # Readings: stop, point, and (4, 4) pose in the instrument's frame.
    rows: tuple[tuple[int, int, FloatArray], ...]


def tracked(options: InstrumentOptions, joints: FloatArray | None = None) -> InstrumentRecord:
    """Moves the arm over its workspace, or to (s, n) joint angles [rad], and reads the points."""
    rng = np.random.default_rng([7, options.seed])
    arm = arm_named(options.robot)
    true_arm = options.built(rng)
    x = compose(exp(np.array([[0.1, -0.2, 2.5, 0, 0, 0]]))[0, :3, :3], np.array([2.5, -1.0, 0.4]))
    rotation = exp(np.array([[0.5, 1.0, -0.3, 0, 0, 0]]))[0, :3, :3] if options.poses else np.eye(3)
    z = compose(rotation, np.array(options.points[0]))
    if joints is None:
        joints = random_postures(arm, options.stops, rng)
    count = len(joints)
    loads, approach = options.loads(count), options.approach(count)
    flange = options.flange_at(true_arm, joints, loads, approach) @ options.jitter(count, rng)
    rows = []
    for stop, pose in enumerate(flange):
        for point, place in enumerate(options.points):
            on_flange = z if point == 0 else compose(np.eye(3), np.array(place))
            true = invert(x) @ pose @ on_flange
            noise = exp(np.r_[rng.normal(size=3) * options.sigma_rad, 0, 0, 0][None])[0, :3, :3]
            place_read = true[:3, 3] + options.sigma_m * rng.normal(size=3)
            rows.append((stop, point, compose(true[:3, :3] @ noise, place_read)))
    return InstrumentRecord(options, arm, true_arm, x, z, joints, tuple(rows))


def random_postures(arm: DhArm, stops: int, rng: np.random.Generator) -> FloatArray:
    """Random postures over the workspace, above the table [rad]."""
    kept: list[FloatArray] = []
    while len(kept) < stops:
        q = drawn_postures(arm, 1, rng)
        if forward(arm, q)[0, 2, 3] > 0.1:
            kept.append(q[0])
    return np.array(kept)


def session_of(
    shop: InstrumentRecord, *, joints: bool = True, poses: bool = False, **document: object
) -> Session:
    """The session in memory, with joint angles or the nominal arm's poses.

    `document` are tables of session.toml that replace the correct ones.
    """
    options = shop.options
    nominal = forward(shop.arm, shop.joints)
    payloads = options.loads(len(shop.joints))
    rows = []
    for view, (stop, point, read) in enumerate(shop.rows):
        keys = POSE if options.poses else POSE[:3]
        numbers = {f"meas_{key}": value for key, value in pose_row(read).items() if key in keys}
        if poses:
            numbers |= pose_row(nominal[stop])
        if joints:
            numbers |= {
                f"q{at}_rad": joint for at, joint in enumerate(shop.joints[stop].tolist(), 1)
            }
        if payloads:
            numbers |= payloads[stop].row()
        name = "abc"[point] if len(options.points) > 1 else ""
        rows.append({"view": view, "stop": stop, "point": name} | numbers)
    noise = {"sigma_m": options.sigma_m}
    if options.poses:
        noise["sigma_rad"] = options.sigma_rad
    facts = {"schema": 1, "name": "tracked", "instrument": noise}
    facts |= {"robot": {"model": options.robot}} if joints else {}
    if shop.arm.is_planar:
        wrong_m = CALIPER_M * np.random.default_rng([8, options.seed]).standard_normal()
        height = {"z_m": float(shop.flange_from_probe[2, 3] + wrong_m), "sigma_m": CALIPER_M}
        facts["prior"] = {"flange_from_probe": height}
    cells = [[str(value) for value in row.values()] for row in rows]
    return Session.assemble(facts | document, list(rows[0]), cells, MemoryImages({}))


def write_tracked(shop: InstrumentRecord, folder: Path) -> None:
    """Writes a session's folder, and the truth in `<folder>.truth.json` beside it.

    Raises:
        DataError: The folder cannot be written.
    """
    session_of(shop, name=folder.name).save(folder)
    content = {
        "schema": 1,
        "transforms": {
            "base_from_instrument": shop.base_from_instrument,
            "flange_from_probe": shop.flange_from_probe,
        },
        "options": asdict(shop.options),
        "arm": asdict(shop.true_arm),
    }
    write_truth(folder, content)
