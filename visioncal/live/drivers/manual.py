"""An arm without a connection: a person types or pastes its poses from the pendant."""

import time
from collections.abc import Callable

import numpy as np

from visioncal.core.conventions import POSE_FORMS
from visioncal.core.documents.pendants import PendantPose, possible_forms, read_pose
from visioncal.core.errors import DataError, DriverError
from visioncal.core.number_format import did_you_mean
from visioncal.core.transforms import rotation_angle
from visioncal.core.types import FloatArray
from visioncal.live.drivers.protocols import ArmState

# Our own form has the name of whom it is shared with.
_OURS = {"ours": "ros"}


class ManualArm:
    """An arm without motion, whose state is the pose that a person enters.

    It asks until it has understood a pose, shows how, and takes it when the person agrees.

    Args:
        ask: Asks a question and gives the line that was typed.
        form: In which form poses are typed: a name among `POSE_FORMS`, or `ours`; None to have it
            recognised by their numbers, and asked where these leave it open.
        answers: Whether a person answers. Lines of a file are a pose each: nothing is asked back,
            and the file's end, which a `q` is too, raises EOFError.

    Raises:
        DriverError: There is no such form.
    """

    def __init__(
        self, ask: Callable[[str], str], form: str | None = None, *, answers: bool = True
    ) -> None:
        self._ask, self.answers = ask, answers
        self._form = None if form is None else _known(form)

    @property
    def name(self) -> str:
        """What it is."""
        return "poses typed by hand"

    def state(self) -> ArmState:
        """Asks for the pose of the flange; it takes as long as the person does.

        Raises:
            DriverError: The input is at its end; or a line of a file is no pose, as a pose that was
                passed over would shift all that follow.
        """
        if not self.answers:
            return self._next()
        line = self._answer("Pose of the flange: ")
        while True:
            found = self._read(line)
            if isinstance(found, str):
                line = self._answer(f"{found}\nPose of the flange: ")
                continue
            line = self._answer(
                f"Read as {found.words}: {pose_words(found.pose)}. Enter takes it; else type it "
                "again: "
            )
            if not line.strip():
                return ArmState(time.monotonic(), found.pose)

    def _next(self) -> ArmState:
        """The pose of the next line of a file that is not empty."""
        while not (line := self._ask("").strip()):
            pass
        if line.lower() == "q":
            raise EOFError
        forms = possible_forms(line)
        if self._form is None and len(forms) > 1:
            raise DriverError(
                f"{line!r} may be a pose of {', '.join(forms)}.",
                culprits=["stdin"],
                next_step=f"Say which: --pose-form {forms[0]}.",
            )
        found = self._read(line)
        if isinstance(found, str):
            raise DriverError(found, culprits=["stdin"], next_step="Correct it: a pose a line.")
        return ArmState(time.monotonic(), found.pose)

    def close(self) -> None:
        """Lets go of it; there is nothing to let go of."""

    def _read(self, line: str) -> PendantPose | str:
        """Reads a line; why it cannot be read, in words."""
        forms = possible_forms(line)
        while self._form is None and len(forms) > 1:
            # Asked once: a pendant does not change its form from pose to pose.
            said = self._answer(f"That may be a pose of {', '.join(forms)}. Which is it? ").strip()
            self._form = said if said in forms else None
        try:
            return read_pose(line, "the line", self._form)
        except DataError as error:
            return str(error)

    def _answer(self, question: str) -> str:
        try:
            return self._ask(question)
        except EOFError as error:
            raise DriverError("The poses that were typed are at their end.") from error


def pose_words(pose: FloatArray) -> str:
    """Words a (4, 4) pose [m] as a person can compare it with a pendant, whatever its form."""
    x, y, z = 1e3 * pose[:3, 3]
    turned = np.rad2deg(rotation_angle(pose))
    down = pose[:3, 2]
    return (
        f"x {x:.2f}, y {y:.2f}, z {z:.2f} mm; turned by {turned:.2f} deg; the flange points along "
        f"({down[0]:.2f}, {down[1]:.2f}, {down[2]:.2f})"
    )


def _known(form: str) -> str:
    name = _OURS.get(form, form)
    if name not in POSE_FORMS:
        names = (*_OURS, *POSE_FORMS)
        raise DriverError(
            f"There is no form of poses {form!r}; {', '.join(names)} are there.",
            culprits=["--pose-form"],
            next_step=did_you_mean(form, names),
        )
    return name
