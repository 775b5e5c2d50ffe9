"""Arm without a connection, whose poses a person types or pastes from the pendant."""

import time
from collections.abc import Callable

import numpy as np

from visioncal.core.conventions import POSE_FORMS
from visioncal.core.documents.pendants import PendantPose, possible_forms, read_pose
from visioncal.core.errors import DataError, DriverError
from visioncal.core.number_format import did_you_mean
from visioncal.core.transforms import rotation_angle
from visioncal.core.types import FloatArray
from visioncal.live.drivers.protocols import Answer, ArmState

# Visioncal's own form is that of ROS.
_OURS = {"ours": "ros"}


class ManualArm:
    """Arm whose state is the pose that a person enters.

    It asks until it can read a pose, shows its interpretation, and uses it once confirmed.

    Args:
        ask: Asks a question and returns the line that was typed.
        form: Form of the typed poses: a name among `POSE_FORMS`, or `ours`; None to recognise it
            from their numbers, and to ask where these are ambiguous.
        answers: Whether a person answers. Otherwise each line of a file is a pose, no questions are
            asked, and the file's end or a `q` raises EOFError.

    Raises:
        DriverError: There is no such form.
    """

    name = "poses typed by hand"

    def __init__(
        self, ask: Callable[[str], str], form: str | None = None, *, answers: bool = True
    ) -> None:
        self._ask, self.answers = ask, answers
        self._form = None if form is None else form_name(form)

    @property
    def invitation(self) -> str:
        """How poses are given where no question is asked."""
        reads = "Poses are read from stdin, one a line, and no question is asked; q ends."
        return "" if self.answers else reads

    def request(self, timeout_s: float, wanted: str = "") -> ArmState:  # noqa: ARG002
        """Asks whether a view is to be taken, and for its pose, without a timeout.

        Raises:
            EOFError: The person types `q`, or the input has ended.
            DriverError: As for `state`.
        """
        question = f"{wanted}: Enter takes it, q ends: "
        if self.answers and self._ask(question).strip().lower() == "q":
            raise EOFError
        return self.state()

    def reply(self, answer: Answer, reason: str = "") -> None:
        """Nothing: the person reads the view's report."""

    def state(self) -> ArmState:
        """Asks for the pose of the flange, without a timeout.

        Raises:
            DriverError: The input has ended; or a line of a file is no pose, and skipping it would
                shift all that follow.
        """
        if not self.answers:
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
            pose = self._read(line)
            if isinstance(pose, str):
                raise DriverError(
                    pose, culprits=["stdin"], next_step="Correct it: one pose per line."
                )
            return ArmState(time.monotonic(), pose.pose, pose_form=pose.form.name)
        line = self._answer("Pose of the flange: ")
        while True:
            pose = self._read(line)
            if isinstance(pose, str):
                line = self._answer(f"{pose}\nPose of the flange: ")
                continue
            line = self._answer(
                f"Read as {pose.words}: {pose_words(pose.pose)}. Enter takes it; else type it "
                "again: "
            )
            if not line.strip():
                return ArmState(time.monotonic(), pose.pose, pose_form=pose.form.name)

    def close(self) -> None:
        """Holds no resources."""

    def _read(self, line: str) -> PendantPose | str:
        """Reads a pose from a line; else the reason in words."""
        forms = possible_forms(line)
        while self._form is None and len(forms) > 1:
            # Asked once: a pendant keeps its form.
            chosen = self._answer(f"It may be a pose of {', '.join(forms)}: of which? ").strip()
            self._form = chosen if chosen in forms else None
        try:
            return read_pose(line, "the line", self._form)
        except DataError as error:
            return str(error)

    def _answer(self, question: str) -> str:
        try:
            return self._ask(question)
        except EOFError as error:
            raise DriverError("No typed pose is left.") from error


def pose_words(pose: FloatArray) -> str:
    """Describes a (4, 4) pose [m] so that it can be compared with a pendant of any form."""
    x, y, z = 1e3 * pose[:3, 3]
    turned = np.rad2deg(rotation_angle(pose))
    axis = pose[:3, 2]
    return (
        f"x {x:.2f}, y {y:.2f}, z {z:.2f} mm; turned by {turned:.2f} deg; the flange points along "
        f"({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f})"
    )


def form_name(form: str) -> str:
    """Name among `POSE_FORMS` of a form that the user states; raises DriverError."""
    name = _OURS.get(form, form)
    if name not in POSE_FORMS:
        names = (*_OURS, *POSE_FORMS)
        raise DriverError(
            f"There is no form of poses {form!r}; the names are {', '.join(names)}.",
            culprits=["--pose-form"],
            next_step=did_you_mean(form, names),
        )
    return name
