"""Base parameters that a motion does not determine, and why."""

from collections.abc import Sequence

import numpy as np

from visioncal.core.errors import DegenerateError
from visioncal.core.files import some_of
from visioncal.core.types import FloatArray
from visioncal.dynamics.base import BaseModel, random_motion
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.regression import Block

# A joint that never gets faster than this stands still, and its speed is noise [rad/s].
_STILL_RAD_S = 0.01
# Not determined are directions with less than this share of a full motion's information.
# Fast multi-sines get 1e-4 of it along the worst direction, motion about one axis 1e-16.
_UNDETERMINED = 1e-9
# Parameters with this share of an undetermined direction are named with it.
_SHARE = 0.3
_NEXT = (
    "Let all joints move at once, to and fro, fast and over a wide range: visioncal dynamics plan "
    "writes such a motion."
)


def check_turning(base: BaseModel, streams: Sequence[Conditioned]) -> None:
    """Refuses motions in which a joint stands still.

    Raises:
        DegenerateError: One does.
    """
    fastest = np.max(
        [np.abs(it.measured.motion.dq).max(axis=0) for of in streams for it in of.pieces], axis=0
    )
    still = np.flatnonzero(fastest < _STILL_RAD_S)
    if not len(still):
        return
    names = base.model.robot.joint_names
    stopped = [f"joint {it + 1} ({names[it]})" for it in still]
    kept = zip(base.names, base.independent, strict=True)
    lost = [name for name, at in kept if _joint_of(base.model.names[at]) in still + 1]
    raise DegenerateError(
        f"dynamics: {some_of(stopped)} {'stands' if len(stopped) == 1 else 'stand'} still in "
        f"{some_of([it.label for it in streams])} (at most {fastest[still].max():.2g} rad/s): "
        f"{len(lost)} of {base.rank} base parameters, {some_of(lost, 5)}, are not determined.",
        culprits=stopped,
        next_step=_NEXT,
    )


def _joint_of(name: str) -> int:
    """The joint, from 1, of a parameter as `m4*cx4` or `Fc4`."""
    return int(name[len(name.rstrip("0123456789")) :])


def check_identifiable(base: BaseModel, blocks: Sequence[Block]) -> None:
    """Refuses motions that leave a combination of base parameters open.

    Raises:
        DegenerateError: There is one; its main parameters are named.
    """
    lost = null_space(base, blocks)
    if lost:
        names = base.names
        raise DegenerateError(
            f"dynamics: the motion does not determine {len(lost)} of {base.rank} base parameters: "
            f"{some_of([names[it] for it in lost], 5)}.",
            culprits=[names[it] for it in lost],
            next_step=_NEXT,
        )


def null_space(base: BaseModel, blocks: Sequence[Block]) -> list[int]:
    """The base parameters in directions about which a motion says nothing."""
    information = np.zeros((base.rank, base.rank))
    rows = 0
    for block in blocks:
        for joint in range(block.y.shape[1]):
            x = block.x[:, joint]
            information += x.T @ x
            rows += len(x)
    sizes = _usual(base)
    relative = information / np.outer(sizes, sizes) / max(rows, 1)
    values, vectors = np.linalg.eigh(relative)
    null = np.flatnonzero(values < _UNDETERMINED)
    shares = np.sqrt(np.sum(vectors[:, null] ** 2, axis=1))
    return [int(it) for it in np.flatnonzero(shares > _SHARE)]


def _usual(base: BaseModel) -> FloatArray:
    """(b,) root mean square of each column in a motion all around."""
    rows = base.regressor(random_motion(base.model, np.random.default_rng(1)))
    return np.asarray(np.sqrt(np.mean(rows.reshape(-1, base.rank) ** 2, axis=0)))
