"""Dynamics identified of simulated arms and of a real one, and against figaroh.

figaroh is no part of the development environment: `pip install -e .[bench]`. Without it, or without
the recording of a Panda, their parts are left out.

    PYTHONPATH=tests python tests/benchmarks/dynamics.py [WORLDS]
"""

from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from multiprocessing import Pool
from pathlib import Path
from time import process_time

import numpy as np
from results import few, wished, write_section
from support.moved_arms import recorded, robot_with_bodies, true_base

from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.conditioning import Conditioned, LowPass, Piece, condition
from visioncal.dynamics.excitation import ExcitationRequest, excite
from visioncal.dynamics.identify import SLOW_RAD_S, Identification, Options, identify
from visioncal.dynamics.limits import MotionMargins, motion_limits
from visioncal.dynamics.model import DynamicModel, FrictionTerms
from visioncal.dynamics.motion import JointMotion, Measured
from visioncal.dynamics.reading import RecordedSamples
from visioncal.dynamics.validate import fit_friction_to_known, predict, validate
from visioncal.robot import load_robot, small_urdf
from visioncal.simulation.dynamics import drive_torques, nominal_dynamics, real_dynamics
from visioncal.simulation.exercise import Exercise, multi_sine, slow_sweep

WORLDS, RATE_HZ, REPEATS = 20, 500.0, few(3, 1)
SEARCH = few(ExcitationRequest(), ExcitationRequest(starts=1, steps=3))
PANDA = Path(__file__).parents[3] / "shared" / "data" / "dyn_franka_panda"
PANDA_LIMITS = (5.0, 1.5, 2.4, 4.9, 6.2, 3.4, 17.9)
WITH_ROTORS = FrictionTerms(motor_inertia=True, slow_rad_s=SLOW_RAD_S)


@dataclass(frozen=True, eq=False)
class World:
    """What came of one simulated UR5e.

    Attributes:
        share: Chi-square of all base parameters over their number.
        humps: That of humps of friction and their speeds.
        noise: (n,) error of a fresh motion's torques over their noise.
        consistent: The same by bodies.
        known: The same by the published inertias.
        bodies: Whether all links are bodies.
    """

    share: float
    humps: float
    noise: FloatArray
    consistent: FloatArray
    known: FloatArray
    bodies: bool


def excitation(name: str) -> Exercise:
    """The motion that `visioncal dynamics plan` writes for an arm."""
    allowed = motion_limits(load_robot(name), MotionMargins())
    motion = excite(allowed, SEARCH).series.sampled(RATE_HZ)
    return Exercise(motion.times_s, motion.q, motion.dq, motion.ddq)


def world(job: tuple[int, Exercise]) -> World:
    """One UR5e, off by a fifth from what is published, at 3 % of torque noise."""
    seed, motion = job
    rng = np.random.default_rng(seed)
    built = real_dynamics("ur5e", rng, stribeck=True)
    streams = [
        recorded(built, exercise, rng)
        for exercise in (motion, slow_sweep(6, rng, seconds=few(60.0, 15.0)))
    ]
    found = identify(load_robot("ur5e"), streams, Options(terms=WITH_ROTORS))
    result = found.identified
    away = result.values - true_base(result.base, built)
    size = result.base.rank
    noise, consistent, known = fresh_errors(found, built, rng)
    return World(
        chi2(away, result.covariance[:size, :size]) / size,
        humps_chi2(found, built),
        noise,
        consistent,
        known,
        result.inertias is not None and result.inertias.consistent,
    )


def chi2(away: FloatArray, covariance: FloatArray) -> float:
    """Squared errors in units of their covariance."""
    return float(away @ np.linalg.solve(covariance, away))


def humps_chi2(found: Identification, built) -> float:
    """That of all humps and logarithms of speeds, over their number; NaN where one is missing."""
    humps, size = found.identified.stribeck, found.identified.base.rank
    if len(humps.joints) < 6:
        return float("nan")
    gears = built.gears
    away = [humps.hump_nm - gears.stribeck, np.log(humps.speed_rad_s / gears.stribeck_speed)]
    return chi2(np.concatenate(away), found.identified.covariance[size:, size:]) / 12.0


def fresh_errors(found: Identification, built, rng) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unfiltered errors of predicted torques of a fresh motion over the torques' noise."""
    fresh = multi_sine(6, rng)
    stream = recorded(built, fresh, rng)
    motion = stream.pieces[0].measured.motion
    begin = int(np.searchsorted(fresh.times_s, motion.times_s[0] - 1e-6))
    true = drive_torques(built, fresh.q, fresh.dq, fresh.ddq)
    noise = 0.03 * np.sqrt(np.mean(true**2, axis=0))
    prediction = predict(found.identified, stream, fit_friction_to_known(found))
    result = validate(found.identified, prediction)
    known = result.known_rms_nm / result.rms_nm

    def ratio(torques: FloatArray) -> FloatArray:
        off = np.mean((torques - true[begin : begin + len(motion)]) ** 2, axis=0)
        return np.sqrt(1.0 + off / noise**2)

    identified = found.identified
    return ratio(identified.torques(motion)), ratio(identified.consistent_torques(motion)), known


def worlds_text(found: list[World]) -> str:
    """What the simulated arms came to."""
    shares = np.array([item.share for item in found])
    humps = np.array([item.humps for item in found])
    noise = max(float(item.noise.max()) for item in found)
    consistent = max(float(item.consistent.max()) for item in found)
    known = np.array([item.known for item in found])
    return WORLD_TEXT.format(
        worlds=len(found),
        share=shares.mean(),
        most=shares.max(),
        humps=np.nanmean(humps),
        missed=int(np.isnan(humps).sum()),
        noise=noise,
        consistent=consistent,
        bodies=sum(item.bodies for item in found),
        known=float(np.median(known)),
    )


def ranks_text() -> str:
    """Numbers of base parameters, without and with three terms of friction a joint."""
    none = FrictionTerms(coulomb=False, viscous=False, offset=False)
    lines = ["| robot | links alone | with friction |", "| --- | ---: | ---: |"]
    for name in ("ur5e", "ur10e", "panda"):
        ranks = [
            BaseModel.reduce(DynamicModel(load_robot(name), friction_terms)).rank
            for friction_terms in (none, FrictionTerms())
        ]
        lines.append(f"| {name} | {ranks[0]} | {ranks[1]} |")
    return "\n".join(lines)


def panda_text() -> str:
    """A real Panda: first 70 % to train, last 30 % to test, 8 Hz."""
    if not PANDA.is_dir():
        return "The recording of a Panda is not there."
    q, dq, torques = (
        np.loadtxt(PANDA / f"{name}.txt").reshape(-1, 7)
        for name in ("positions", "velocity", "torques")
    )
    whole = RecordedSamples("panda", np.loadtxt(PANDA / "time.txt"), q, dq, torques)
    train, test = (condition(whole.part(*pair), 8.0) for pair in ((0.0, 0.7), (0.7, 1.0)))
    found = identify(load_robot("panda"), [train])
    result = validate(
        found.identified, predict(found.identified, test, fit_friction_to_known(found))
    )
    rows = {
        "a plain script": np.array(PANDA_LIMITS),
        "base parameters": 100.0 * result.shares,
        "bodies": 100.0 * result.consistent_rms_nm / result.torque_nm,
        "published inertias, friction fitted": 100.0 * result.known_rms_nm / result.torque_nm,
    }
    lines = [
        f"| {name} | {' | '.join(f'{value:.1f}' for value in row)} |" for name, row in rows.items()
    ]
    head = ["| error over the range of the torque, % | 1 | 2 | 3 | 4 | 5 | 6 | 7 |"]
    return "\n".join([*head, "| --- |" + " ---: |" * 7, *lines])


def figaroh_text() -> str:
    """10,000 exact states of a UR5e, by figaroh and by visioncal, in one process."""
    if find_spec("figaroh") is None:
        return "figaroh is not installed."
    from figaroh_torques import identify as of_figaroh

    robot, measured = robot_with_bodies(nominal_dynamics("ur5e")), exact_motion()
    stream, plain = unfiltered(measured), FrictionTerms(slow_rad_s=SLOW_RAD_S)
    options = Options(terms=plain, stribeck=False, consistent=False, checked=False)
    theirs, ours, whole = [], [], []
    with one_blas_thread():
        for _ in range(REPEATS):
            theirs.append(of_figaroh(robot, small_urdf(robot), measured))
            seconds, found = timed(partial(identify, robot, [stream], options))
            ours.append(seconds)
            whole.append(
                timed(partial(identify, robot, [stream], replace(options, consistent=True)))[0]
            )
    rms = np.sqrt(np.mean(found.fit.residuals[0] ** 2, axis=0))
    full, bare = min(their.seconds for their in theirs), min(their.bare_seconds for their in theirs)
    return FIGAROH_TEXT.format(
        parameters=theirs[0].parameters,
        own=found.identified.base.rank,
        full=full,
        bare=bare,
        ours=min(ours),
        whole=min(whole),
        faster=full / min(ours),
        bare_faster=bare / min(ours),
        rms=", ".join(f"{rm:.3f}" for rm in theirs[0].rms_nm),
        own_rms=", ".join(f"{rm:.3f}" for rm in rms),
    )


def unfiltered(measured: Measured) -> Conditioned:
    """Samples that need no filter, as they are."""
    rate_hz = 1.0 / float(np.median(np.diff(measured.motion.times_s)))
    bad = np.zeros(measured.torques_nm.shape, dtype=bool)
    piece = Piece(measured, bad, np.ones(len(measured), dtype=bool), LowPass(np.ones(1), 1))
    return Conditioned("samples", (piece,), 0.5 * rate_hz, 0.5 * rate_hz, rate_hz, ())


def exact_motion() -> Measured:
    """10,000 samples whose torques have 3 % of noise; friction of three terms, no rotors."""
    rng = np.random.default_rng(0)
    built, done = real_dynamics("ur5e", rng), multi_sine(6, rng)
    built = replace(built, gears=replace(built.gears, motor_inertia=np.zeros(6)))
    torques = drive_torques(built, done.q, done.dq, done.ddq)
    noise = 0.03 * np.sqrt(np.mean(torques**2, axis=0)) * rng.standard_normal(torques.shape)
    return Measured(JointMotion(done.times_s, done.q, done.dq, done.ddq), torques + noise)


def timed(run) -> tuple[float, Identification]:
    """Processor time, and what came out."""
    begun = process_time()
    found = run()
    return process_time() - begun, found


def main(worlds: int) -> None:
    """Prints all parts and keeps them."""
    motion = excitation("ur5e")
    with Pool() as pool:
        found = pool.map(world, [(seed, motion) for seed in range(worlds)])
    parts = (ranks_text(), worlds_text(found), panda_text(), figaroh_text())
    text = TEXT.format(*parts)
    print(text)
    command = "PYTHONPATH=tests python tests/benchmarks/dynamics.py"
    write_section("Dynamic identification", command, text)


TEXT = """Base parameters:

{0}

{1}

A real Franka Panda (Gaz et al. 2019: one exciting motion of 21 s at 1 kHz), trained on its first
70 %, tested on its last 30 %, torques and regressor filtered at 8 Hz, by joint:

{2}

{3}
"""
WORLD_TEXT = """
{worlds} simulated UR5e, whose masses and inertias differ by a fifth from the published ones, with
Coulomb, viscous, offset and Stribeck friction and rotors; 3 % of torque noise, 1e-5 rad of angle
noise; one motion of `visioncal dynamics plan` of 20 s and a slow sweep of 60 s, at 500 Hz. The
fresh motion is a random multi-sine.

| what | came to |
| --- | ---: |
| chi-square of the 58 base parameters over 58, mean | {share:.2f} |
| largest | {most:.2f} |
| chi-square of Fs - Fc and vs over 12, mean | {humps:.2f} |
| worlds in which a joint's hump was missed | {missed} |
| error of a fresh motion's torques over their noise, worst joint of all worlds | {noise:.3f} |
| the same by bodies | {consistent:.3f} |
| published inertias with fitted friction over identified ones, filtered, median | {known:.1f} |
| worlds in which all links are bodies | {bodies} |"""
FIGAROH_TEXT = """
10,000 samples of a UR5e with exact states and 3 % of torque noise, Coulomb, viscous and offset
friction, in one process on one thread, the least of three times. figaroh 1.0.2 is timed
as `initialize` and `solve(decimate=False, plotting=False, wls=True)`, and once more for its
regressor, its decomposition and its weighting alone; visioncal from states and torques to base
parameters with their covariance, and also to bodies.

| | base parameters | processor [s] | rms of the torques [N m] |
| --- | ---: | ---: | --- |
| figaroh | {parameters} | {full:.2f} | {rms} |
| figaroh, bare | {parameters} | {bare:.2f} | |
| visioncal | {own} | {ours:.3f} | {own_rms} |
| visioncal, with bodies | | {whole:.3f} | |

{faster:.1f} times faster than figaroh, {bare_faster:.1f} times than its bare steps."""

if __name__ == "__main__":
    main(wished(WORLDS))
