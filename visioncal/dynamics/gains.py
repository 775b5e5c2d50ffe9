"""What torque a current makes: the gains of drives, by a payload that is known.

From motion alone an arm twice as heavy with gains twice as high is the same arm. A body whose mass,
centre and inertia are known, carried in one of two runs, separates them (Gautier and Briot 2014,
Global identification of joint drive gains and dynamic parameters of robots).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from visioncal.core.errors import DegenerateError
from visioncal.core.types import FloatArray
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.motion import Motion
from visioncal.robot import body_regressor

# A gain that is known no better than to this share of itself counts as not determined [-].
_WORST = 0.1
# Columns of which less is left are multiples of others [-].
_RANK = 1e-8


@dataclass(frozen=True, eq=False)
class Gains:
    """The gains of n drives.

    Attributes:
        nm_per_a: (n,) torque about the joint for a current [N m/A].
        sigma: (n,) standard deviations [N m/A]; inf where the payload does not move the joint.
    """

    nm_per_a: FloatArray
    sigma: FloatArray

    @property
    def determined(self) -> FloatArray:
        """(n,) which of them are determined to a tenth of their value."""
        return np.asarray(self.sigma < _WORST * np.abs(self.nm_per_a))


def drive_gains(
    base: BaseModel,
    empty: Sequence[Conditioned],
    loaded: Sequence[Conditioned],
    body: FloatArray,
) -> Gains:
    """Finds the drives' gains.

    Each joint's current is a sum of what the arm takes, in the joint's own measure, and of the
    known torque of the payload over the gain. The former is eliminated (Frisch and Waugh 1933).

    Args:
        base: The arm's model.
        empty: Motions without the payload; `torques_nm` are currents [A] here.
        loaded: The same with it.
        body: (10,) the payload's inertial parameters in the flange's frame.

    Raises:
        DegenerateError: No joint's gain is determined.
    """
    robot = base.model.robot

    def load(motion: Motion) -> FloatArray:
        return np.asarray(body_regressor(robot, motion.q, motion.dq, motion.ddq) @ body)

    streams = (*empty, *loaded)
    own = np.concatenate([it.filtered(base.regressor) for it in streams])
    pulls = np.concatenate(
        [np.zeros_like(it.torques_nm) for it in empty] + [it.filtered(load) for it in loaded]
    )
    currents = np.concatenate([it.torques_nm for it in streams])
    used = np.concatenate([it.used for it in streams])
    found = np.array(
        [
            _gain(own[rows, joint], pulls[rows, joint], currents[rows, joint])
            for joint, rows in enumerate(used.T)
        ]
    )
    gains = Gains(found[:, 0], found[:, 1])
    if not gains.determined.any():
        raise DegenerateError(
            "drive gains: the payload's torques stand out at no joint.",
            next_step="Carry a heavier one, off the last joint's axis, and move all joints.",
        )
    return gains


def _gain(own: FloatArray, load: FloatArray, currents: FloatArray) -> tuple[float, float]:
    """A joint's gain and its sigma, from rows of what it takes (m, b), the load, the currents."""
    acts = own.any(axis=0)
    lengths = np.linalg.norm(own[:, acts], axis=0)
    directions, upper, _ = qr(own[:, acts] / lengths, mode="economic", pivoting=True)
    left = np.abs(np.diag(upper))
    directions = directions[:, left > _RANK * left[0]]
    load = load - directions @ (directions.T @ load)
    currents = currents - directions @ (directions.T @ currents)
    square = float(load @ load)
    if square <= 0.0:
        return 0.0, np.inf
    share = float(load @ currents) / square
    rest = currents - share * load
    freedom = max(len(rest) - directions.shape[1] - 1, 1)
    sigma = float(np.sqrt(rest @ rest / freedom / square))
    if share == 0.0:
        return 0.0, np.inf
    return 1.0 / share, sigma / share**2
