"""The arm as it is now: fed with temperatures or currents, asked for its model."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.robot import Robot
from visioncal.robot.thermal.model import ThermalModel

_MINUTES = 60.0
# How far ahead advice looks [s], and how finely.
_AHEAD_S, _EVERY_S = 10 * 3600.0, 30.0
# Rates of measured temperatures are taken over so long [s]: sensors are noisy.
_SPAN_S = 600.0
# An arm whose rise has not slowed down visibly is expected to settle so slowly [s]; one whose rise
# has all but ended keeps this share of its rate from one span to the next.
_SLOWEST_S, _LEAST_SHARE = 3600.0, 1e-3


@dataclass(frozen=True)
class Advice:
    """Whether the arm is warm enough.

    Attributes:
        rate_um_min: How fast the flange drifts now [um/min].
        limit_um_min: How fast it may [um/min].
        wait_s: How long until then if work goes on as it does; zero where it is warm, None where it
            does not come to that within ten hours or too few samples were given as yet.
    """

    rate_um_min: float | None
    limit_um_min: float
    wait_s: float | None

    @property
    def words(self) -> str:
        """The advice in a sentence."""
        if self.rate_um_min is None:
            return "Too few temperatures were given to say how fast the arm drifts."
        now = f"The flange drifts by {self.rate_um_min:.2g} um/min"
        if self.wait_s is None:
            return f"{now} and does not come under {self.limit_um_min:g} within ten hours."
        if self.wait_s <= 0.0:
            return f"{now}, under the limit of {self.limit_um_min:g}: the arm is warm."
        minutes = self.wait_s / _MINUTES
        return f"{now}: go on warming up for {minutes:.0f} min to come under {self.limit_um_min:g}."


@dataclass(frozen=True, eq=False)
class _Sample:
    """The links at a sample.

    Attributes:
        rest: (n,) where they would come to rest [deg C].
        driven: (n,) what of that is by motor currents [K].
        links: (n,) what they have [deg C].
        jacobian: (n, s) how that moves with the heating's parameters; see `Heating.jacobian`.
    """

    rest: FloatArray
    driven: FloatArray
    links: FloatArray
    jacobian: FloatArray


class OnlineCompensator:
    """Follows an arm's temperatures.

    Feed it what was measured, as often as it is; ask it for the arm as it is now. It begins with
    links in balance: as warm as their joints at the first sample or, fed with currents, as the air.
    """

    def __init__(self, model: ThermalModel) -> None:
        """Begins without a sample."""
        self._model = model
        self._stamps_s: list[float] = []
        self._links: list[FloatArray] = []
        self._last: _Sample | None = None

    def feed(
        self,
        stamp_s: float,
        *,
        temperatures_c: FloatArray | None = None,
        currents_a: FloatArray | None = None,
        ambient_c: float | None = None,
    ) -> None:
        """Takes up a sample.

        Args:
            stamp_s: When; later than the sample before [s].
            temperatures_c: (n,) of the joints, where the model was fitted to these.
            currents_a: (n,) of the motors, where it was fitted to these [A].
            ambient_c: The air, with currents; that of the reference where it is not given.

        Raises:
            DataError: The time does not ascend, the wrong kind was given, or numbers are missing.
        """
        heating, count = self._model.heating, self._model.joint_count
        given = temperatures_c if heating.kind == "temperatures" else currents_a
        signal = np.asarray([] if given is None else given, dtype=float)
        if signal.shape != (count,) or not np.isfinite(signal).all():
            raise DataError(
                f"thermal: the model was fitted to {heating.kind}; {count} of them are needed in a "
                f"sample, not {signal.tolist()}."
            )
        if self._stamps_s and stamp_s <= self._stamps_s[-1]:
            raise DataError(
                f"thermal: a sample at {stamp_s:g} s does not come after the one before, at "
                f"{self._stamps_s[-1]:g} s."
            )
        signal = signal if heating.kind == "temperatures" else signal**2
        air = float(self._model.reference_c.mean()) if ambient_c is None else ambient_c
        self._last = self._after(signal, air, stamp_s)
        self._stamps_s.append(stamp_s)
        self._links.append(self._last.links)
        self._forget()

    def _after(self, signal: FloatArray, air: float, stamp_s: float) -> _Sample:
        """The links at a new sample of what heats them (n,) and of the air [deg C]."""
        heating, last = self._model.heating, self._last
        ambient = np.array([air])
        rest = heating.rest(signal[None], ambient)[0]
        driven = rest - air if heating.kind == "currents" else np.zeros_like(rest)
        if last is None:
            still = np.zeros((len(rest), heating.size // len(rest)))
            return _Sample(rest, driven, heating.cold(signal[None], ambient), still)
        seconds = stamp_s - self._stamps_s[-1]
        mean = 0.5 * (rest + last.rest)
        by = 0.5 * (driven + last.driven)
        links = heating.step(last.links, mean, seconds)
        jacobian = heating.step_jacobian(last.jacobian, last.links, mean, by, seconds)
        return _Sample(rest, driven, links, jacobian)

    @property
    def links_c(self) -> FloatArray:
        """(n,) temperatures of the links now [deg C].

        Raises:
            DataError: Nothing was fed yet.
        """
        return self._now.links

    @property
    def _now(self) -> _Sample:
        if self._last is None:
            raise DataError("thermal: the compensator was fed with no sample yet.")
        return self._last

    @property
    def robot(self) -> Robot:
        """The arm as it is now."""
        return self._model.robot_at(self.links_c)

    def base_from_flange(self, q: FloatArray) -> FloatArray:
        """Where the flange stands now (m, 4, 4), at (m, n) joint angles [rad]."""
        return self._model.base_from_flange(q, self.links_c)

    def sigma_m(self, q: FloatArray) -> FloatArray:
        """(m,) how surely its drift is known at (m, n) joint angles [m]; see `ThermalModel`.

        Raises:
            DataError: Nothing was fed yet.
        """
        now = self._now
        jacobian = np.broadcast_to(now.jacobian, (len(q), *now.jacobian.shape))
        return self._model.sigma_m(q, now.links, jacobian)

    def advice(self, q: FloatArray, limit_um_min: float) -> Advice:
        """Says whether the arm is warm enough to work, and else how long to wait.

        Args:
            q: (n,) the posture at work [rad].
            limit_um_min: How fast the flange may drift [um/min].

        Raises:
            DataError: The limit is not above zero.
        """
        if not limit_um_min > 0.0:
            raise DataError(f"thermal: a limit of {limit_um_min:g} um/min is not above zero.")
        found = self._settling()
        if found is None:
            return Advice(None, limit_um_min, None)
        speeds, tau_s = found
        jacobian = 1e6 * _MINUTES * self._model.jacobian(q[None])[0, 3:]
        ahead = np.arange(0.0, _AHEAD_S, _EVERY_S)
        speeds = speeds * np.exp(-ahead[:, None] / tau_s)
        rates = np.linalg.norm(speeds @ jacobian.T, axis=1)
        over = np.flatnonzero(rates >= limit_um_min)
        if not len(over):
            wait = 0.0
        elif over[-1] + 1 < len(ahead):
            wait = float(ahead[over[-1] + 1])
        else:
            wait = None
        return Advice(float(rates[0]), limit_um_min, wait)

    def _settling(self) -> tuple[FloatArray, FloatArray] | None:
        """How fast links warm up (n,) [K/s], and how that fades (n,) [s]; None for too little."""
        heating = self._model.heating
        if heating.kind == "currents":
            if self._last is None:
                return None
            return (self._last.rest - self._last.links) / heating.tau_s, heating.tau_s
        stamps = np.array(self._stamps_s)
        if not len(stamps) or stamps[-1] - stamps[0] < 2.0 * _SPAN_S:
            return None
        then = stamps[-1] - _SPAN_S * np.arange(3)
        links = [np.interp(then, stamps, column) for column in np.array(self._links).T]
        late, early = -np.diff(np.stack(links, axis=1), axis=0) / _SPAN_S
        # One share for all joints: those of single ones would follow the work from piece to piece.
        slowed = float(late @ early) / max(float(early @ early), 1e-12)
        slowed = min(max(slowed, _LEAST_SHARE), float(np.exp(-_SPAN_S / _SLOWEST_S)))
        tau_s = np.full_like(late, -_SPAN_S / np.log(slowed))
        return late, np.maximum(tau_s, heating.tau_s)

    def _forget(self) -> None:
        """Drops samples older than rates need."""
        while len(self._stamps_s) > 2 and self._stamps_s[1] < self._stamps_s[-1] - 2.1 * _SPAN_S:
            self._stamps_s.pop(0)
            self._links.pop(0)
