"""Thermal drift of an arm: heating of its links, their growth, and online compensation.

A link is one RC element: `tau ds/dt = rest - s`, with its steady-state temperature `rest`. Where
temperatures of the joints are measured, that is the joint's, and tau is the link's lag behind its
sensor; where only motor currents are recorded, it is the air's plus a gain times the squared
current. From one sample to the next it is constant, at the mean, for which the step is exact.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Self, TypeAlias

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import exp
from visioncal.core.types import FloatArray, interpolated
from visioncal.robot import Robot

Kind: TypeAlias = Literal["temperatures", "currents"]


@dataclass(frozen=True, eq=False)
class Inputs:
    """Recorded signals that heat an arm with n joints, at t samples."""

    kind: Kind  # Whether joint temperatures or motor currents were recorded.
    stamps_s: FloatArray  # (t,) ascending [s].
    signal: FloatArray  # (t, n) joint temperatures [deg C], or squared motor currents [A^2].
    # (t,) air temperature [deg C]; zero where not recorded: others are then relative.
    ambient_c: FloatArray

    def before(self, later: "Inputs") -> "Inputs":
        """The samples, followed by later ones."""
        parts = zip(
            (self.stamps_s, self.signal, self.ambient_c),
            (later.stamps_s, later.signal, later.ambient_c),
            strict=True,
        )
        return Inputs(self.kind, *(np.concatenate(pair) for pair in parts))


@dataclass(frozen=True, eq=False)
class Heating:
    """Heating model of n links."""

    kind: Kind  # The recorded signal.
    tau_s: FloatArray  # (n,) time constants [s].
    # (n,) steady-state rise over the air per squared current [K/A^2]; ones for temperatures.
    gain_k_per_a2: FloatArray

    @property
    def size(self) -> int:
        """Number of parameters: logarithms of the time constants, and of the gains."""
        return len(self.tau_s) * (1 if self.kind == "temperatures" else 2)

    def changed(self, steps: FloatArray) -> Self:
        """The model after a step (size,) of its parameters."""
        count = len(self.tau_s)
        gain = self.gain_k_per_a2
        if self.kind == "currents":
            gain = gain * np.exp(steps[count:])
        return replace(self, tau_s=self.tau_s * np.exp(steps[:count]), gain_k_per_a2=gain)

    def links_c(self, inputs: Inputs, at_s: FloatArray) -> FloatArray:
        """Link temperatures (m, n) at (m,) times [deg C]."""
        return interpolated(at_s, inputs.stamps_s, self.course(inputs)[:, :, 0])

    def jacobian(self, inputs: Inputs, at_s: FloatArray) -> FloatArray:
        """Derivatives of the link temperatures over the parameters.

        Returns:
            (m, n, s) over the parameters of the link's own joint: the logarithms of tau and, for
            currents, of the gain.
        """
        parts = np.moveaxis(self.course(inputs)[:, :, 1:], 2, 0)
        return np.stack([interpolated(at_s, inputs.stamps_s, part) for part in parts], axis=2)

    def course(self, inputs: Inputs, start: FloatArray | None = None) -> FloatArray:
        """Link temperatures at the samples and their derivatives, (t, n, 1 + s); see `jacobian`.

        `start` (n, 1 + s) are those at the first sample; in equilibrium where None.
        """
        has_gains, air_c = self.kind == "currents", inputs.ambient_c[:, None]
        # Steady-state temperatures (t, n) of the links, and their part by motor currents.
        driven = self.gain_k_per_a2 * inputs.signal if has_gains else np.zeros_like(inputs.signal)
        rest = air_c + driven if has_gains else inputs.signal
        if start is None:
            start = np.zeros((rest.shape[1], 3 if has_gains else 2))
            start[:, 0] = air_c[0] if has_gains else inputs.signal[0]
        shares = np.diff(inputs.stamps_s)[:, None] / self.tau_s
        kept = np.exp(-shares)
        rests, drives = (0.5 * (values[:-1] + values[1:]) for values in (rest, driven))
        first, *by_parameter = start.T[:, None]
        states = _scanned(first, kept, (1.0 - kept) * rests)
        columns = [states, _scanned(by_parameter[0], kept, kept * shares * (states[:-1] - rests))]
        if has_gains:
            columns.append(_scanned(by_parameter[1], kept, (1.0 - kept) * drives))
        return np.stack(columns, axis=2)


def _scanned(first: FloatArray, kept: FloatArray, added: FloatArray) -> FloatArray:
    """Solves `x[k + 1] = kept[k] x[k] + added[k]`, (t, n), by doubling (Hillis, Steele 1986)."""
    kept = np.concatenate([np.ones_like(first), kept])
    added = np.concatenate([first, added])
    shift = 1
    while shift < len(added):
        added[shift:] = added[shift:] + kept[shift:] * added[:-shift]
        kept[shift:] = kept[shift:] * kept[:-shift]
        shift *= 2
    return added


@dataclass(frozen=True, eq=False)
class ThermalModel:
    """An arm whose n joints each heat the link after them.

    A link's lengths, a and d of its joint table, grow in proportion to the rise of its temperature,
    and the joint's zero drifts with it.
    """

    robot: Robot  # The arm at the reference temperatures.
    heating: Heating  # Heating model of the links.
    reference_c: FloatArray  # (n,) reference temperatures of the links [deg C].
    growth_per_k: FloatArray  # (n,) relative growth of links [1/K].
    drift_rad_per_k: FloatArray  # (n,) drift of the joints' zeros [rad/K].
    covariance: FloatArray  # (2 n + h, 2 n + h) of growth, drift and the heating's h parameters.
    # (n + 1, 3) growing vectors from each joint's frame to the next, in the former [m].
    lengths: FloatArray

    @property
    def joint_count(self) -> int:
        """The number n of joints."""
        return self.robot.joint_count

    def changed(self, steps: FloatArray) -> Self:
        """The model after a (2 n + h,) step of its parameters, in the order of their covariance."""
        count = self.joint_count
        return replace(
            self,
            growth_per_k=self.growth_per_k + steps[:count],
            drift_rad_per_k=self.drift_rad_per_k + steps[count : 2 * count],
            heating=self.heating.changed(steps[2 * count :]),
        )

    def columns(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Right perturbations (m, 6, n) of the flange for growth of links and rotation of joints.

        Returns:
            For a relative growth of 1 of each link, and for 1 rad of each joint, at (m, n) joint
            angles [rad].
        """
        count = self.joint_count
        placements = self.robot.placement_jacobian(q).reshape(len(q), 6, count + 1, 6)[:, :, 1:, 3:]
        grown = np.einsum("mikj,kj->mik", placements, self._growing)
        turned = self.robot.function_jacobian(q).reshape(len(q), 6, count, 4)[..., 0]
        return np.asarray(grown), np.asarray(turned)

    def jacobian(self, q: FloatArray) -> FloatArray:
        """Jacobian (m, 6, n) of the flange over the link temperatures [rad/K and m/K]."""
        grown, turned = self.columns(q)
        return np.asarray(grown * self.growth_per_k + turned * self.drift_rad_per_k)

    def motion(self, q: FloatArray, links_c: FloatArray) -> FloatArray:
        """Displacement (m, 4, 4) of the flange from the reference, in its own frame."""
        rises = self.rises(links_c)
        return exp(np.einsum("mij,mj->mi", self.jacobian(q), np.broadcast_to(rises, q.shape)))

    def base_from_flange(self, q: FloatArray, links_c: FloatArray) -> FloatArray:
        """Flange poses (m, 4, 4) [m] at joint angles (m, n) [rad] and temperatures (m, n) or (n,).

        Raises:
            DataError: The shapes do not match.
        """
        return np.asarray(self.robot.base_from_flange(q) @ self.motion(q, links_c))

    def robot_at(self, links_c: FloatArray) -> Robot:
        """The arm with its links at (n,) temperatures [deg C]."""
        rises = self.rises(links_c)
        placements, functions = np.zeros((self.joint_count + 1, 6)), np.zeros((len(rises), 4))
        placements[1:, 3:] = self._growing * (self.growth_per_k * rises)[:, None]
        functions[:, 0] = self.drift_rad_per_k * rises
        return self.robot.corrected(placements, functions)

    def basis(self, q: FloatArray, links_c: FloatArray, heated: FloatArray) -> FloatArray:
        """Jacobian (m, 6, p) of the flange over all parameters, in the order of their covariance.

        Args:
            q: (m, n) joint angles [rad].
            links_c: (m, n) temperatures of the links [deg C].
            heated: (m, n, k) their derivatives over the k kinds of heating parameters
                (`Heating.jacobian`).
        """
        grown, turned = self.columns(q)
        rises, jacobian = self.rises(links_c)[:, None, :], self.jacobian(q)
        parts = [jacobian * heated[:, None, :, at] for at in range(heated.shape[2])]
        return np.concatenate([grown * rises, turned * rises, *parts], axis=2)

    def sigma_m(
        self, q: FloatArray, links_c: FloatArray, heated: FloatArray | None = None
    ) -> FloatArray:
        """Predicted sigma (m,) of the flange's drift: root of the trace of its covariance [m].

        Args:
            q: (m, n) joint angles [rad].
            links_c: (m, n) temperatures of the links, or (n,) for all [deg C].
            heated: (m, n, k) as in `basis`; None leaves out the uncertainty of the heating.
        """
        links_c = np.broadcast_to(links_c, q.shape)
        none = np.zeros((*q.shape, 0))
        jacobian = self.basis(q, links_c, none if heated is None else heated)[:, 3:]
        size = jacobian.shape[2]
        covariance = jacobian @ self.covariance[:size, :size] @ np.swapaxes(jacobian, 1, 2)
        return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2)))

    def rises(self, links_c: FloatArray) -> FloatArray:
        """Rise of link temperatures over the reference [K].

        Raises:
            DataError: The number of temperatures differs from that of the joints.
        """
        links_c = np.asarray(links_c, dtype=float)
        if not links_c.ndim or links_c.shape[-1] != self.joint_count:
            raise DataError(
                f"robot {self.robot.name}: temperatures have the shape {links_c.shape}, but must "
                f"be {self.joint_count}, one for each joint."
            )
        return np.asarray(links_c - self.reference_c)

    @cached_property
    def _growing(self) -> FloatArray:
        """(n, 3) growing vectors of the links in the frames after them [m]."""
        rotations = self.robot.chain.placements[1:, :3, :3]
        return np.asarray(np.einsum("kji,kj->ki", rotations, self.lengths[1:]))


class OnlineCompensator:
    """Tracks the link temperatures of an arm, and gives its current model.

    Feed it every measured sample. The links start in equilibrium: at the temperatures of their
    joints at the first sample or, fed with currents, of the air.
    """

    def __init__(self, model: ThermalModel) -> None:
        """Prepares a compensator without samples."""
        self._model = model
        # The last sample, and (n, 1 + s) temperatures of the links with their derivatives there.
        self._last: Inputs | None = None
        self._state: FloatArray | None = None

    def feed(
        self,
        stamp_s: float,
        *,
        temperatures_c: FloatArray | None = None,
        currents_a: FloatArray | None = None,
        ambient_c: float | None = None,
    ) -> None:
        """Adds a sample.

        Args:
            stamp_s: Time, later than the sample before [s].
            temperatures_c: (n,) of the joints, for a model of temperatures [deg C].
            currents_a: (n,) of the motors, for a model of currents [A].
            ambient_c: Of the air, with currents; that of the reference by default [deg C].

        Raises:
            DataError: Times do not ascend, the wrong signal was given, or numbers are missing.
        """
        heating, count = self._model.heating, self._model.joint_count
        given = temperatures_c if heating.kind == "temperatures" else currents_a
        signal = np.asarray([] if given is None else given, dtype=float)
        if signal.shape != (count,) or not np.isfinite(signal).all():
            raise DataError(
                f"thermal: the model was fitted to {heating.kind}: a sample must have {count} of "
                f"them, not {signal.tolist()}."
            )
        if self._last is not None and stamp_s <= self._last.stamps_s[0]:
            raise DataError(
                f"thermal: a sample at {stamp_s:g} s does not come after the one before, at "
                f"{self._last.stamps_s[0]:g} s."
            )
        signal = signal if heating.kind == "temperatures" else signal**2
        air = float(self._model.reference_c.mean()) if ambient_c is None else ambient_c
        inputs = Inputs(heating.kind, np.array([stamp_s]), signal[None], np.array([air]))
        samples = inputs if self._last is None else self._last.before(inputs)
        self._last, self._state = inputs, heating.course(samples, self._state)[-1]

    @property
    def links_c(self) -> FloatArray:
        """(n,) temperatures of the links now [deg C].

        Raises:
            DataError: There is no sample yet.
        """
        return self._now[:, 0]

    @property
    def _now(self) -> FloatArray:
        if self._state is None:
            raise DataError("thermal: the compensator has no sample yet.")
        return self._state

    @property
    def robot(self) -> Robot:
        """Current model of the arm."""
        return self._model.robot_at(self.links_c)

    def base_from_flange(self, q: FloatArray) -> FloatArray:
        """Current flange poses (m, 4, 4) at (m, n) joint angles [rad]."""
        return self._model.base_from_flange(q, self.links_c)

    def sigma_m(self, q: FloatArray) -> FloatArray:
        """(m,) predicted sigma of the drift at (m, n) joint angles [m]; see `ThermalModel`.

        Raises:
            DataError: There is no sample yet.
        """
        jacobian = np.broadcast_to(self._now[:, 1:], (len(q), *self._now[:, 1:].shape))
        return self._model.sigma_m(q, self.links_c, jacobian)
