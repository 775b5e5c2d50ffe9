"""Recording of joint states during a motion that another program drives."""

from collections import deque
from collections.abc import Callable

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.live.drivers.protocols import Arm, ArmState
from visioncal.session import Stream

# Rest that is kept before and after a motion, for filters to settle [s].
_LEAD_S = 1.0


def record_motion(
    arm: Arm,
    rate_hz: float,
    *,
    rest_s: float = 3.0,
    patience_s: float = 120.0,
    report: Callable[[str], None] = lambda _: None,
) -> Stream:
    """Waits for a motion, and records it until the joints have come to rest.

    Args:
        arm: An arm that reports angles, speeds and currents.
        rate_hz: Rate of its states.
        rest_s: Rest after which the motion has ended [s].
        patience_s: How long to wait for the motion [s].
        report: Called with progress messages.

    Returns:
        Times on the controller's clock, angles, speeds and currents.

    Raises:
        DriverError: No motion starts, the arm is stopped, or its states cannot be read.
    """
    before_motion: deque[ArmState] = deque(maxlen=max(int(_LEAD_S * rate_hz), 1))
    first = arm.state()
    report(f"waiting for the {arm.name} to move: start its program now")
    while not _moves(state := arm.state(), arm.name):
        before_motion.append(state)
        if state.controller_s - first.controller_s > patience_s:
            raise DriverError(
                f"The {arm.name} has not moved for {patience_s:g} s.",
                culprits=[arm.name],
                next_step="Start the program on the pendant while this command waits.",
            )
    report("it moves")
    states, moved_s = [*before_motion, state], state.controller_s
    while state.controller_s - moved_s < rest_s:
        state = arm.state()
        states.append(state)
        if _moves(state, arm.name):
            moved_s = state.controller_s
    report(f"it has come to rest after {moved_s - states[0].controller_s:.1f} s")
    states = [one for one in states if one.controller_s <= moved_s + _LEAD_S]
    stamps_s = np.array([one.controller_s for one in states])
    # Some are sent twice.
    ascending = np.concatenate([[True], np.diff(stamps_s) > 0.0])
    forms = {"q{}_rad": "q", "dq{}_rad_s": "dq", "current{}_a": "currents_a"}
    parts = [np.array([getattr(one, name) for one in states]) for name in forms.values()]
    columns = [form.format(at + 1) for form in forms for at in range(parts[0].shape[1])]
    return Stream(("stamp_s", *columns), np.column_stack([stamps_s, *parts])[ascending])


def _moves(state: ArmState, name: str) -> bool:
    if state.safety not in ("normal", "reduced"):
        raise DriverError(
            f"The {name} is stopped: {state.safety}.",
            culprits=[name],
            next_step="See the pendant, and record the motion again from its beginning.",
        )
    # Slower is noise of a joint at rest [rad/s].
    return state.dq is not None and bool(np.abs(state.dq).max() > 0.005)
