"""The example of a medium arm that is loaded at its flange, read by a tracker."""

import numpy as np
from support.tracked import known_of

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.core.types import FloatArray
from visioncal.simulation import Payload, arm_named, forward
from visioncal.simulation.arms import loaded_joints
from visioncal.simulation.instrument_session import (
    InstrumentOptions,
    InstrumentRecord,
    random_postures,
    session_of,
    tracked,
)

# Shoulder and elbow yield, the rest does not [N m/rad].
STIFFNESS = (np.inf, 1.4e6, 9e5, np.inf, np.inf, np.inf)
COMPLIANCE = tuple(float(value) for value in 1.0 / np.array(STIFFNESS))
GRAVITY = 9.80665
LOADS_N = (0.0, 10.0, 20.0, 50.0)
HUNG = tuple(Payload(kg=load / GRAVITY) for load in LOADS_N)
NOMINAL = arm_named("generic-6r-1800")
# The arm stretched out, with the longest lever that it has [rad].
STRETCHED = np.array([[0.0, np.pi / 2, -np.pi / 2 + np.arctan2(0.18, 0.8), 0.0, 0.0, 0.0]])


def postures(count: int, seed: int = 0) -> FloatArray:
    """So many postures, each as often as there are loads: it is loaded where it stands."""
    return np.repeat(
        random_postures(NOMINAL, count, np.random.default_rng(seed)), len(LOADS_N), axis=0
    )


def loaded(
    seed: int = 0, count: int = 15, sigma_m: float = 3e-5
) -> tuple[InstrumentRecord, RunState]:
    """The truth, and what is made of it."""
    options = InstrumentOptions(
        robot=NOMINAL.name,
        sigma_m=sigma_m,
        robot_sigma_m=1e-5,
        robot_sigma_rad=1e-5,
        dh_sigma_m=3e-4,
        dh_sigma_rad=3e-4,
        offset_sigma_rad=3e-4,
        compliance_rad_per_nm=COMPLIANCE,
        payloads=HUNG,
        seed=seed,
    )
    shop = tracked(options, postures(count, seed))
    return shop, known_of(session_of(shop))


def deflection_m(shop: InstrumentRecord, q: FloatArray, load: Payload) -> FloatArray:
    """(m, 3) how a load moves the real flange [m]."""
    hung = loaded_joints(shop.true_arm, COMPLIANCE, q, [load] * len(q))
    free = loaded_joints(shop.true_arm, COMPLIANCE, q, [Payload()] * len(q))
    moved = forward(shop.true_arm, hung) - forward(shop.true_arm, free)
    return np.asarray(moved[:, :3, 3])


def predicted_m(known: RunState, q: FloatArray, load: Payload) -> FloatArray:
    """(m, 3) how the calibrated model says that it does [m]."""
    from visioncal.robot import Loads

    model, count = known.robot_arm.model, len(q)
    hung = Loads.alike(count, load.kg, load.centre_m, load.force_n)
    moved = model.base_from_flange(q, hung) - model.base_from_flange(q)
    return np.asarray(moved[:, :3, 3])
