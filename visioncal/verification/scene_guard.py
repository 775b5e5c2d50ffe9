"""A guard of a camera's pose by the standing scene: sequential test of its registered images.

The turn x of look k in group g (one pose of the robot) against the group's reference is

    x = r_g + m [k >= c] + e_k,   r_g ~ N(0, S),   e_k ~ N(0, S + C_k),

with S the harmless motion from look to look, C_k the registration's covariance and m a change at
look c. The statistic is that of Shiryaev and Roberts (Pollak 1987), the sum over c of the
likelihood ratios of a change to none, averaged over sizes of changes. r_g and m are integrated out.
A look is bounded to the length that noise exceeds in one look of a hundred, as it may be of a thing
that moved: no single one raises an alarm. Without a change the statistic grows by about one a look
in the mean, and a false alarm comes after as many looks as its limit, and more by the overshoot.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from visioncal.calibration.stages.detect import image_of
from visioncal.core.errors import DataError
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, Image, Mask, Rejection
from visioncal.results import Calibration
from visioncal.session import Session, View
from visioncal.session.observations import moved
from visioncal.verification.guard_detector import log_ratios
from visioncal.vision.scene import Registration, nothing, register

# Sizes of changes, as sigmas of each component in those of a look: larger ones are found as soon,
# as a look's length is bounded.
_SIZES = np.array([0.3, 1.0])


@dataclass(frozen=True, eq=False)
class SceneLook:
    """Motion of the camera in one view since the reference of its pose."""

    view: int  # Number of the view.
    reference: int  # The first view of the same pose; its own if it is the first.
    found: Registration  # Against the reference.
    holds: bool  # Whether the camera stands as it did, by the looks so far.
    evidence: float  # The statistic over its limit.

    @property
    def document(self) -> dict[str, Any]:
        """A document for JSON."""
        known: dict[str, Any] = {"view": self.view, "reference": self.reference}
        if self.found.reason:
            known["unused"] = self.found.reason
        elif self.view != self.reference:
            turn, sigma = self.found.turn, np.sqrt(np.diag(self.found.covariance))
            values = {"shift_px": self.found.shift_px, "sigma_px": self.found.shift_sigma_px}
            values |= {"turn_deg": np.rad2deg(turn[:3]), "sigma_deg": np.rad2deg(sigma[:3])}
            if len(turn) > 3:
                values |= {"offset_mm": 1e3 * turn[3:], "sigma_mm": 1e3 * sigma[3:]}
            known |= {name: value.round(5).tolist() for name, value in values.items()}
            known["patches"] = self.found.inliers
        return known | {"holds": self.holds, "evidence": float(f"{self.evidence:.3g}")}


class SceneWatch:
    """Decides after every look whether the camera has turned.

    Args:
        unit: (p,) the motion of each component that moves the image by 1 px.
        steady_px: Sigma of harmless motion from look to look, by each component [px].
        false_alarm_looks: Mean number of looks from one false alarm to the next.
    """

    def __init__(self, unit: FloatArray, steady_px: float, false_alarm_looks: float) -> None:
        size = len(unit)
        self._unit, self._limit = unit, false_alarm_looks
        self._steady = steady_px**2 * np.eye(size)
        self._groups, self._priors = np.zeros(0, int), dict[int, FloatArray]()
        self._turns = np.zeros((0, size))  # (n, p) what is left of each look's turn [px].
        self._weights = np.zeros((0, size, size))  # (n, p, p) inverse covariances.
        self._sizes = np.zeros(0)  # (n,) sigma of each look, mean of its components [px].
        self.holds, self.evidence = True, 0.0  # The statistic over its limit.

    def update(self, group: int, turn: FloatArray, covariance: FloatArray) -> None:
        """Takes a look: its (p,) turn against the reference of its group, and the covariance."""
        noise = self._steady + covariance / np.outer(self._unit, self._unit)
        weight, earlier = np.asarray(np.linalg.inv(noise)), self._groups == group
        # The reference's own noise is about that of the group's first look.
        weights = self._weights[earlier]
        known = np.linalg.inv(self._priors.setdefault(group, weight) + weights.sum(axis=0))
        expected = known @ np.einsum("kij,kj->i", weights, self._turns[earlier])
        off, spread, size = turn / self._unit - expected, noise + known, len(turn)
        length2 = max(float(off @ np.linalg.solve(spread, off)), 1e-12)
        # One look may be of a thing that moved: however far off it is, it is bounded. Probability
        # of a longer look by noise alone.
        bound = float(chi2_limit(0.01, size))
        off *= min(1.0, float(np.sqrt(bound / length2)))
        self._sizes = np.append(self._sizes, np.linalg.det(noise) ** (0.5 / size))
        self._groups = np.append(self._groups, group)
        self._turns = np.concatenate([self._turns, [expected + off]])
        self._weights = np.concatenate([self._weights, [weight]])
        # Inverse mean of the statistic over its limit at false alarms, in simulation.
        self.evidence = self._statistic() / (0.6 * self._limit)
        self.holds = self.holds and self.evidence < 1.0

    def _statistic(self) -> float:
        """The sum of likelihood ratios over the look of the change."""
        weights = self._weights
        scores = np.einsum("kij,kj->ki", weights, self._turns)
        information, score = np.zeros_like(weights), np.zeros_like(scores)
        for group, prior in self._priors.items():
            in_group = self._groups == group
            # Of the looks from c on, for every c.
            after = np.cumsum((weights * in_group[:, None, None])[::-1], axis=0)[::-1]
            by_after = np.cumsum((scores * in_group[:, None])[::-1], axis=0)[::-1]
            gain = after @ np.linalg.inv(prior + after[0])
            information += after - gain @ after
            score += by_after - gain @ by_after[0]
        sizes = np.exp(np.log(self._sizes).mean()) * np.ones_like(self._unit)
        ratios = log_ratios(information, score, _SIZES[:, None] * sizes)
        return float(np.exp(np.minimum(ratios, 600.0)).mean(axis=0).sum())


def scene_looks(
    session: Session,
    calibration: Calibration,
    *,
    mask: Mask | None = None,
    plane: str = "",
    steady_px: float = 0.1,
    false_alarm_looks: float = 10_000.0,
) -> Iterator[SceneLook]:
    """Looks at the standing scene by a session's images, in the order of its views.

    Views of a fixed camera are of one group; of one that the robot carries, those at one pose. The
    first usable image of a group is its reference.

    Args:
        session: Its images.
        calibration: Calibration of the camera.
        mask: (h, w) pixels that stand still; None for all.
        plane: The scene's plane, to fit the camera's offset too: `board`, or its distance along the
            camera's axis [mm]; empty for the turn alone.
        steady_px: Sigma of the image's harmless motion from look to look [px].
        false_alarm_looks: Mean number of looks from one false alarm to the next.

    Raises:
        DataError: The calibration has no camera, the mask another size, the plane is not known, or
            too few images could be used.
    """
    if calibration.camera is None:
        raise DataError(
            "guard --scene: the calibration was made from measured poses, and has no lens.",
            next_step="Guard it by looks at the board, without --scene.",
        )
    camera = calibration.camera.camera
    if mask is not None and mask.shape != camera.resolution[::-1]:
        raise DataError(
            f"guard --scene: the mask has {mask.shape[1]} x {mask.shape[0]} px, the camera "
            f"{camera.resolution[0]} x {camera.resolution[1]}.",
            next_step="Draw it over an image of this camera.",
        )
    pairs = _pairs(session, is_fixed=calibration.mount == "eye-to-hand")
    firsts = [first for view, first in pairs if view is first] if plane else []
    planes = {first.number: scene_plane(calibration, first, plane) for first in firsts}
    # A turn about the axis moves the image's corners.
    unit = np.append(1 / camera.matrix[:2], 2 / np.hypot(*camera.resolution))
    if planes:
        unit = np.append(unit, abs(planes[firsts[0].number][3]) * unit)
    watch, used = SceneWatch(unit, steady_px, false_alarm_looks), 0
    references = dict[int, tuple[int, Image]]()
    for view, first in pairs:
        image, group = image_of(session, view), first.number
        known = references.get(group)
        number = view.number if known is None else known[0]
        if isinstance(image, Rejection):
            found = nothing(len(unit), image.reason)
        else:
            reference = image if known is None else known[1]
            found = register(reference, image, camera, mask, planes.get(group))
            if not found.reason and known is not None:
                used += 1
                watch.update(group, found.turn, found.covariance)
            elif not found.reason:
                # An image that is found in itself can be a reference.
                references[group] = number, image
        yield SceneLook(view.number, number, found, watch.holds, watch.evidence)
    if used < 2:
        raise DataError(
            f"guard --scene: {used} images of session {session.name!r} could be compared with an "
            "earlier one of the same pose of the robot, but must be two or more.",
            next_step="Read the reason for each; return to one pose after every job, and take an "
            "image there.",
        )


def _pairs(session: Session, *, is_fixed: bool) -> list[tuple[View, View]]:
    """Each view with an image, and the first one with the camera at the same place."""
    pairs = list[tuple[View, View]]()
    for view in session.views:
        if view.image and not view.is_of_lens:
            firsts = (first for _, first in pairs if is_fixed or not moved(first, view))
            pairs.append((view, next(firsts, view)))
    return pairs


def scene_plane(calibration: Calibration, view: View, stated: str) -> FloatArray:
    """(4,) normal and distance of the scene's plane in the camera's frame of a view [m].

    Raises:
        DataError: It is neither `board` nor a distance, or the board's plane is not known there.
    """
    if stated != "board":
        is_number = stated.replace(".", "", 1).isdecimal()
        if not is_number or not 1.0 <= float(stated) < 1e6:
            raise DataError(f"--plane is {stated!r}, but must be board, or a distance in mm.")
        return np.array([0.0, 0.0, 1.0, 1e-3 * float(stated)])
    flange, names = view.base_from_flange(), ("flange_from_cam", "base_from_target")
    if flange is None or any(name not in calibration.transforms for name in names):
        raise DataError(
            f"--plane board: where the board stands at view {view.number} is not known.",
            next_step="State the plane's distance in mm.",
        )
    flange_from_cam, base_from_target = (calibration.transforms[name].as_matrix() for name in names)
    cam_from_target = invert(flange.as_matrix() @ flange_from_cam) @ base_from_target
    normal = cam_from_target[:3, 2]
    return np.append(normal, normal @ cam_from_target[:3, 3])
