"""First-order heating model of links.

A link is one RC element: `tau ds/dt = rest - s`, with its steady-state temperature `rest`. Where
temperatures of the joints are measured, that is the joint's, and tau is the link's lag behind its
sensor; where only motor currents are recorded, it is the air's plus a gain times the squared
current. From one sample to the next it is constant, at the mean, for which the step is exact.
"""

from dataclasses import dataclass, replace
from typing import Literal, Self, TypeAlias

import numpy as np

from visioncal.core.types import FloatArray

Kind: TypeAlias = Literal["temperatures", "currents"]


@dataclass(frozen=True, eq=False)
class Inputs:
    """Recorded signals that heat an arm with n joints, at t samples."""

    kind: Kind  # Whether joint temperatures or motor currents were recorded.
    stamps_s: FloatArray  # (t,) ascending [s].
    signal: FloatArray  # (t, n) joint temperatures [deg C], or squared motor currents [A^2].
    # (t,) air temperature [deg C]; zero where not recorded: others are then relative.
    ambient_c: FloatArray


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

    def rest(self, signal: FloatArray, ambient_c: FloatArray) -> FloatArray:
        """Steady-state temperatures (t, n) of the links [deg C]."""
        if self.kind == "temperatures":
            return signal
        return np.asarray(ambient_c[:, None] + self.gain_k_per_a2 * signal)

    def cold(self, signal: FloatArray, ambient_c: FloatArray) -> FloatArray:
        """(n,) link temperatures at the first sample, in equilibrium [deg C]."""
        return signal[0] if self.kind == "temperatures" else np.full_like(signal[0], ambient_c[0])

    def step(self, before: FloatArray, rest: FloatArray, seconds: float) -> FloatArray:
        """Link temperatures (n,) after a time at constant steady state [deg C]."""
        return np.asarray(rest + np.exp(-seconds / self.tau_s) * (before - rest))

    def step_jacobian(
        self,
        jacobian: FloatArray,
        before: FloatArray,
        rest: FloatArray,
        driven: FloatArray,
        seconds: float,
    ) -> FloatArray:
        """Propagates the derivatives (n, s) of the temperatures over the parameters by a step.

        Args:
            jacobian: (n, s) derivatives before the step, in the order of `jacobian`.
            before: (n,) temperatures before it [deg C].
            rest: (n,) steady state [deg C].
            driven: (n,) its part by motor currents [K].
            seconds: Duration of the step [s].
        """
        share = seconds / self.tau_s
        kept = np.exp(-share)
        after = kept[:, None] * jacobian
        after[:, 0] += kept * share * (before - rest)
        if self.kind == "currents":
            after[:, 1] += (1.0 - kept) * driven
        return np.asarray(after)

    def links_c(self, inputs: Inputs, at_s: FloatArray) -> FloatArray:
        """Link temperatures (m, n) at (m,) times [deg C]."""
        return self._at(inputs, at_s, self._course(inputs)[0])

    def jacobian(self, inputs: Inputs, at_s: FloatArray) -> FloatArray:
        """Derivatives of the link temperatures over the parameters.

        Returns:
            (m, n, s) over the parameters of the link's own joint: the logarithms of tau and, for
            currents, of the gain.
        """
        states, rests, kept = self._course(inputs)
        shares = np.diff(inputs.stamps_s)[:, None] / self.tau_s
        by_tau = _scanned(np.zeros_like(states[:1]), kept, kept * shares * (states[:-1] - rests))
        parts = [by_tau]
        if self.kind == "currents":
            # The states are linear in the steady state, of which the air's part does not depend on
            # gains.
            without_air = replace(inputs, ambient_c=np.zeros_like(inputs.ambient_c))
            parts.append(self._course(without_air)[0])
        return np.stack([self._at(inputs, at_s, part) for part in parts], axis=2)

    def _course(self, inputs: Inputs) -> tuple[FloatArray, FloatArray, FloatArray]:
        """States (t, n) at the samples; steady states and decay factors (t - 1, n) between them."""
        rest = self.rest(inputs.signal, inputs.ambient_c)
        rests = 0.5 * (rest[:-1] + rest[1:])
        kept = np.exp(-np.diff(inputs.stamps_s)[:, None] / self.tau_s)
        first = self.cold(inputs.signal, inputs.ambient_c)[None]
        return _scanned(first, kept, (1.0 - kept) * rests), rests, kept

    def _at(self, inputs: Inputs, at_s: FloatArray, states: FloatArray) -> FloatArray:
        return np.stack([np.interp(at_s, inputs.stamps_s, column) for column in states.T], axis=1)


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
