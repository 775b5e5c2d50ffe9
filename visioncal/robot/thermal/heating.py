"""First-order warm-up: what drives the temperatures of links, and how they follow.

A link is one RC element: `tau ds/dt = rest - s`. Where temperatures of the joints are measured,
the rest is the joint's, and tau is by how much the link lags behind its sensor; where motor
only currents are recorded, the rest is the air and a gain times the squared current. The rest is
taken for constant, at its mean, from one sample to the next; under that the step is exact.
"""

from dataclasses import dataclass, replace
from typing import Literal, Self, TypeAlias

import numpy as np

from visioncal.core.types import FloatArray

Kind: TypeAlias = Literal["temperatures", "currents"]


@dataclass(frozen=True, eq=False)
class Inputs:
    """What heats an arm with n joints, at t samples.

    Attributes:
        kind: Whether joints' temperatures or motors' currents were recorded.
        stamps_s: (t,) ascending [s].
        signal: (t, n) temperatures of the joints [deg C], or squared currents [A^2].
        ambient_c: (t,) the air; zero where not recorded: temperatures are then relative to it.
    """

    kind: Kind
    stamps_s: FloatArray
    signal: FloatArray
    ambient_c: FloatArray


@dataclass(frozen=True, eq=False)
class Heating:
    """How links follow what heats them.

    Attributes:
        kind: What was recorded.
        tau_s: (n,) time constants [s].
        gain_k_per_a2: (n,) rise over the air for a squared current, at rest [K/A^2]; one where
            temperatures were recorded.
    """

    kind: Kind
    tau_s: FloatArray
    gain_k_per_a2: FloatArray

    @property
    def size(self) -> int:
        """How many parameters it has: logarithms of the time constants, and of the gains."""
        return len(self.tau_s) * (1 if self.kind == "temperatures" else 2)

    def changed(self, steps: FloatArray) -> Self:
        """Returns it after a step (size,) of its parameters."""
        count = len(self.tau_s)
        gain = self.gain_k_per_a2
        if self.kind == "currents":
            gain = gain * np.exp(steps[count:])
        return replace(self, tau_s=self.tau_s * np.exp(steps[:count]), gain_k_per_a2=gain)

    def rest(self, signal: FloatArray, ambient_c: FloatArray) -> FloatArray:
        """Where links would come to rest (t, n), if what heats them stayed [deg C]."""
        if self.kind == "temperatures":
            return signal
        return np.asarray(ambient_c[:, None] + self.gain_k_per_a2 * signal)

    def cold(self, signal: FloatArray, ambient_c: FloatArray) -> FloatArray:
        """(n,) what links have at the first of some samples: in balance with their surroundings."""
        return signal[0] if self.kind == "temperatures" else np.full_like(signal[0], ambient_c[0])

    def step(self, before: FloatArray, rest: FloatArray, seconds: float) -> FloatArray:
        """(n,) temperatures some time after others, under a constant rest [deg C]."""
        return np.asarray(rest + np.exp(-seconds / self.tau_s) * (before - rest))

    def step_jacobian(
        self,
        jacobian: FloatArray,
        before: FloatArray,
        rest: FloatArray,
        driven: FloatArray,
        seconds: float,
    ) -> FloatArray:
        """How temperatures some time after others move with the parameters.

        Args:
            jacobian: (n, s) how they moved with them before, as `jacobian` has them.
            before: (n,) what they were [deg C].
            rest: (n,) where they would come to rest [deg C].
            driven: (n,) what of that is by motor currents [K].
            seconds: The time [s].

        Returns:
            (n, s).
        """
        share = seconds / self.tau_s
        kept = np.exp(-share)
        after = kept[:, None] * jacobian
        after[:, 0] += kept * share * (before - rest)
        if self.kind == "currents":
            after[:, 1] += (1.0 - kept) * driven
        return np.asarray(after)

    def links_c(self, inputs: Inputs, at_s: FloatArray) -> FloatArray:
        """(m, n) temperatures of the links at some times [deg C]."""
        return self._at(inputs, at_s, self._course(inputs)[0])

    def jacobian(self, inputs: Inputs, at_s: FloatArray) -> FloatArray:
        """How the temperatures move with the parameters.

        Returns:
            (m, n, s) derivatives by the parameters of the link's own joint: of the logarithms of
            tau and, where currents were recorded, of the gain.
        """
        states, rests, kept = self._course(inputs)
        hours = np.diff(inputs.stamps_s)[:, None] / self.tau_s
        by_tau = _scanned(np.zeros_like(states[:1]), kept, kept * hours * (states[:-1] - rests))
        parts = [by_tau]
        if self.kind == "currents":
            # The states are linear in the rest, and the air has no part in this.
            alone = replace(inputs, ambient_c=np.zeros_like(inputs.ambient_c))
            parts.append(self._course(alone)[0])
        return np.stack([self._at(inputs, at_s, part) for part in parts], axis=2)

    def _course(self, inputs: Inputs) -> tuple[FloatArray, FloatArray, FloatArray]:
        """States (t, n) at the samples; rests and what is kept (t - 1, n) between them."""
        rest = self.rest(inputs.signal, inputs.ambient_c)
        rests = 0.5 * (rest[:-1] + rest[1:])
        kept = np.exp(-np.diff(inputs.stamps_s)[:, None] / self.tau_s)
        first = self.cold(inputs.signal, inputs.ambient_c)[None]
        return _scanned(first, kept, (1.0 - kept) * rests), rests, kept

    def _at(self, inputs: Inputs, at_s: FloatArray, states: FloatArray) -> FloatArray:
        return np.stack([np.interp(at_s, inputs.stamps_s, column) for column in states.T], axis=1)


def _scanned(first: FloatArray, kept: FloatArray, added: FloatArray) -> FloatArray:
    """(t, n) of `x[k + 1] = kept[k] x[k] + added[k]`, by doubling (Hillis and Steele 1986)."""
    kept = np.concatenate([np.ones_like(first), kept])
    added = np.concatenate([first, added])
    shift = 1
    while shift < len(added):
        added[shift:] = added[shift:] + kept[shift:] * added[:-shift]
        kept[shift:] = kept[shift:] * kept[:-shift]
        shift *= 2
    return added
