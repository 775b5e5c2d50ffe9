"""Recording of joint states during a motion that another program drives."""

from collections import deque
from collections.abc import Callable

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.live.drivers.protocols import Joints, JointSample
from visioncal.session import Stream

# Speed from which a joint counts as moving [rad/s].
_MOVING_RAD_S = 0.005
# Rest that is kept before and after a motion, for filters to settle [s].
_LEAD_S = 1.0


def record_motion(
    joints: Joints,
    *,
    rest_s: float = 3.0,
    patience_s: float = 120.0,
    report: Callable[[str], None] = lambda _: None,
) -> Stream:
    """Waits for a motion, and records it until the joints have come to rest.

    Args:
        joints: Source of joint states.
        rest_s: Rest after which the motion has ended [s].
        patience_s: How long to wait for the motion [s].
        report: Called with progress messages.

    Returns:
        Times on the controller's clock, angles, speeds and currents.

    Raises:
        DriverError: No motion starts, or the joints cannot be read.
    """
    before_motion: deque[JointSample] = deque(maxlen=max(int(_LEAD_S * joints.rate_hz), 1))
    first = joints.sample()
    report(f"waiting for the {joints.name} to move: start its program now")
    while not _moves(sample := joints.sample()):
        before_motion.append(sample)
        if sample.stamp_s - first.stamp_s > patience_s:
            raise DriverError(
                f"The {joints.name} has not moved for {patience_s:g} s.",
                culprits=[joints.name],
                next_step="Start the program on the pendant while this command waits.",
            )
    report("it moves")
    samples, moved_s = [*before_motion, sample], sample.stamp_s
    while sample.stamp_s - moved_s < rest_s:
        sample = joints.sample()
        samples.append(sample)
        if _moves(sample):
            moved_s = sample.stamp_s
    report(f"it has come to rest after {moved_s - samples[0].stamp_s:.1f} s")
    samples = [one for one in samples if one.stamp_s <= moved_s + _LEAD_S]
    stamps_s = np.array([one.stamp_s for one in samples])
    # Some are sent twice.
    ascending = np.concatenate([[True], np.diff(stamps_s) > 0.0])
    forms = {"q{}_rad": "q", "dq{}_rad_s": "dq", "current{}_a": "currents_a"}
    numbers = range(1, len(first.q) + 1)
    columns = [form.format(joint) for form in forms for joint in numbers]
    parts = [np.array([getattr(one, name) for one in samples]) for name in forms.values()]
    return Stream(("stamp_s", *columns), np.column_stack([stamps_s, *parts])[ascending])


def _moves(sample: JointSample) -> bool:
    return bool(np.abs(sample.dq).max() > _MOVING_RAD_S)
