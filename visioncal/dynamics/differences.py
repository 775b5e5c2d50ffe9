"""Causes of torques that identified dynamics do not predict: a mistake, friction, a body."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.limits import CLEAR_RATIO, DynamicsLimits
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.convention_hypotheses import check_recording
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.identify import Identification, Options, identify, predict
from visioncal.dynamics.model import FrictionTerms, JointMotion
from visioncal.dynamics.regression import NoiseBlock, regress, rms_of, std_of
from visioncal.robot import Robot
from visioncal.robot.torques import body_regressor

_LIMITS = DynamicsLimits()


def check_as_identified(identified: Identified, streams: Sequence[Conditioned]) -> None:
    """Refuses recordings that are plainly mistaken, by the identified inertias of the arm."""
    base, model = identified.base, identified.base.model
    robot = replace(model.robot, inertias=identified.inertias)
    check_recording(replace(base, model=replace(model, robot=robot)), streams)


def excess_block(
    identified: Identified, stream: Conditioned, terms: FrictionTerms, *, body: bool
) -> NoiseBlock:
    """Torques in excess of the arm's own, over a body on the flange and changes of friction."""
    robot = identified.robot

    def columns(motion: JointMotion) -> FloatArray:
        friction = terms.columns(motion)
        if not body:
            return friction
        onto = body_regressor(robot, motion.q, motion.dq, motion.ddq)
        return np.concatenate([onto, friction], axis=2)

    excess = stream.torques_nm - stream.filtered(identified.torques)
    return NoiseBlock(stream.filtered(columns), excess, stream.used, stream.correlation)


def difference_of(identified: Identified, stream: Conditioned) -> str:
    """Names what explains a stream's excess of torques, friction or a body; empty if neither."""
    slow = identified.base.model.terms.slow_rad_s
    dry = FrictionTerms(offset=False, slow_rad_s=slow)
    none = FrictionTerms(coulomb=False, viscous=False, offset=False)
    ranges_nm = np.maximum(std_of(stream.torques_nm, stream.used), 1e-12)
    found: list[tuple[float, str]] = []
    for terms, body in ((dry, False), (none, True), (dry, True)):
        block = excess_block(identified, stream, terms, body=body)
        try:
            fit = regress([block])
        except np.linalg.LinAlgError:
            continue
        left, before = (
            float(np.linalg.norm(rms_of(values, block.used) / ranges_nm))
            for values in (block.y - block.predicted(fit.values), block.y)
        )
        # Both together are looked for where neither explains the excess.
        if left * CLEAR_RATIO < before and not (found and body and terms.coulomb):
            parts = [_body_words(float(fit.values[0]))] if body else []
            parts += (
                [_friction_words(identified, fit.values[-2 * len(ranges_nm) :])]
                if terms.coulomb
                else []
            )
            found.append((left, " and ".join(parts)))
    return min(found)[1] if found else ""


def _body_words(kg: float) -> str:
    return f"{figure(abs(kg))} kg {'more' if kg > 0.0 else 'less'} were on the flange"


def _friction_words(identified: Identified, changes: FloatArray) -> str:
    """Words on changes (2 n) of dry and viscous friction, joint by joint."""
    names = [identified.base.model.names[index] for index in identified.base.independent]
    joints = range(1, len(changes) // 2 + 1)
    known = dict(zip(names, identified.values.tolist(), strict=True))
    dry_nm = np.array([known.get(f"Fc{joint}", 0.0) for joint in joints])
    if not (dry_nm > 0.0).any():
        return "dry friction acts otherwise, and was not fitted"
    ratio = float(np.median(1.0 + changes[::2] / np.where(dry_nm > 0.0, dry_nm, np.inf)))
    return f"dry friction was {ratio:.3g} times as much, as of colder or warmer gears"


def scale_difference(identification: Identification) -> str:
    """Names the joint whose torques are off by a factor beside those of the others, if one is."""
    fit, found = identification.fit, []
    ranges_nm = [np.maximum(std_of(block.y, block.used), 1e-12) for block in fit.blocks]

    def left(residuals: Sequence[FloatArray], blocks: Sequence[NoiseBlock]) -> float:
        triples = zip(residuals, blocks, ranges_nm, strict=True)
        return float(np.linalg.norm([rms_of(e, block.used) / nm for e, block, nm in triples]))

    before = left(fit.residuals, fit.blocks)
    for joint in range(len(ranges_nm[0])):
        joint_mask = np.arange(len(ranges_nm[0])) == joint
        # With its measured torque in the regressor, the joint's rows fit any multiple of it.
        blocks = [
            replace(
                block,
                x=np.concatenate(
                    [block.x, np.where(joint_mask, -block.y, 0.0)[:, :, None]], axis=2
                ),
            )
            for block in fit.blocks
        ]
        scaled = regress(blocks)
        found.append((left(scaled.residuals, scaled.blocks), joint, float(scaled.values[-1])))
    after, joint, change = min(found)
    if after * CLEAR_RATIO > before or change <= -1.0:
        return ""
    return (
        f"The torques of joint {joint + 1} are {1.0 / (1.0 + change):.3g} times what they are by "
        "those of the other joints."
    )


def stream_differences(
    robot: Robot, streams: Sequence[Conditioned], options: Options
) -> Iterator[str]:
    """Names how streams differ from the first one, whose own fit does not predict them."""
    first, *others = streams
    basic_options = Options(options.terms, stribeck=False, consistent=False, checked=False)
    try:
        reference = identify(robot, [first], basic_options).identified
    except (DataError, DegenerateError, np.linalg.LinAlgError):
        return
    for stream in others:
        ahead = predict(reference, stream)
        shares = ahead.rms_nm(ahead.predicted_nm) / np.maximum(ahead.torque_nm, 1e-12)
        if shares.max() > _LIMITS.differs_share:
            words = difference_of(reference, stream)
            if words:
                yield f"{stream.label} was recorded otherwise than {first.label}: {words}."
