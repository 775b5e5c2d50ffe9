"""Online compensation of thermal drift from measured temperatures or currents."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.robot import Robot
from visioncal.robot.thermal.model import ThermalModel

_MINUTES = 60.0
# Horizon and step of the predicted drift rate [s].
_AHEAD_S, _EVERY_S = 10 * 3600.0, 30.0
# Time span over which rates of noisy measured temperatures are taken [s].
_SPAN_S = 600.0
# Greatest time constant of the warm-up [s], for rates that do not decrease visibly, and least
# factor of the rate from one span to the next.
_SLOWEST_S, _LEAST_SHARE = 3600.0, 1e-3


@dataclass(frozen=True)
class Advice:
    """Current drift rate of the flange, and time until it is below a limit."""

    rate_um_min: float | None  # Drift rate of the flange now [um/min]; None after too few samples.
    limit_um_min: float  # Its limit [um/min].
    # Time until it is below the limit if work continues [s]; zero where it is already, None where
    # it takes more than ten hours or after too few samples.
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
    """Temperatures of the links at a sample."""

    rest: FloatArray  # (n,) steady state [deg C].
    driven: FloatArray  # (n,) its part by motor currents [K].
    links: FloatArray  # (n,) current temperatures [deg C].
    # (n, s) their derivatives over the heating's parameters; see `Heating.jacobian`.
    jacobian: FloatArray


class OnlineCompensator:
    """Tracks the link temperatures of an arm, and gives its current model.

    Feed it every measured sample. The links start in equilibrium: at the temperatures of their
    joints at the first sample or, fed with currents, of the air.
    """

    def __init__(self, model: ThermalModel) -> None:
        """Prepares a compensator without samples."""
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
        # Samples that are too old for the rates.
        while len(self._stamps_s) > 2 and self._stamps_s[1] < stamp_s - 2.1 * _SPAN_S:
            self._stamps_s.pop(0)
            self._links.pop(0)

    def _after(self, signal: FloatArray, air: float, stamp_s: float) -> _Sample:
        """Link temperatures after a sample of the signal (n,) and of the air [deg C]."""
        heating, last = self._model.heating, self._last
        ambient = np.array([air])
        rest = heating.rest(signal[None], ambient)[0]
        driven = rest - air if heating.kind == "currents" else np.zeros_like(rest)
        if last is None:
            still = np.zeros((len(rest), heating.size // len(rest)))
            return _Sample(rest, driven, heating.cold(signal[None], ambient), still)
        seconds = stamp_s - self._stamps_s[-1]
        mean_rest = 0.5 * (rest + last.rest)
        mean_driven = 0.5 * (driven + last.driven)
        links = heating.step(last.links, mean_rest, seconds)
        jacobian = heating.step_jacobian(last.jacobian, last.links, mean_rest, mean_driven, seconds)
        return _Sample(rest, driven, links, jacobian)

    @property
    def links_c(self) -> FloatArray:
        """(n,) temperatures of the links now [deg C].

        Raises:
            DataError: There is no sample yet.
        """
        return self._now.links

    @property
    def _now(self) -> _Sample:
        if self._last is None:
            raise DataError("thermal: the compensator was fed with no sample yet.")
        return self._last

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
        now = self._now
        jacobian = np.broadcast_to(now.jacobian, (len(q), *now.jacobian.shape))
        return self._model.sigma_m(q, now.links, jacobian)

    def advice(self, q: FloatArray, limit_um_min: float) -> Advice:
        """Tells whether the arm is warm enough for work, and otherwise how long to wait.

        Args:
            q: (n,) the posture at work [rad].
            limit_um_min: Acceptable drift rate of the flange [um/min].

        Raises:
            DataError: The limit is not positive.
        """
        if not limit_um_min > 0.0:
            raise DataError(f"thermal: a limit of {limit_um_min:g} um/min is not above zero.")
        settling = self._settling()
        if settling is None:
            return Advice(None, limit_um_min, None)
        speeds, tau_s = settling
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
        """Warm-up rates (n,) [K/s] and time constants (n,) [s]; None after too few samples."""
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
        latest, earlier = -np.diff(np.stack(links, axis=1), axis=0) / _SPAN_S
        # One factor for all joints: those of single joints would follow each work cycle.
        decay = float(latest @ earlier) / max(float(earlier @ earlier), 1e-12)
        decay = min(max(decay, _LEAST_SHARE), float(np.exp(-_SPAN_S / _SLOWEST_S)))
        tau_s = np.full_like(latest, -_SPAN_S / np.log(decay))
        return latest, np.maximum(tau_s, heating.tau_s)
