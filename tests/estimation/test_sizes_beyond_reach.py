"""Sizes of an arm's errors that only rounding prefers."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from visioncal.estimation.arm import find_arm_errors
from visioncal.estimation.arm_sizes import _sized
from visioncal.robot.arm_model import COMPLIANCE


def likelihood(sigma: float, gain: float) -> SimpleNamespace:
    """Likelihood of one robot at 20 stops that prefers errors of its links of a size."""
    extended = SimpleNamespace(
        most_likely=lambda start, *_: (
            (np.array([1e-4, 1e-4, sigma]), -0.5 * gain)
            if start[-1] == 0.1
            else (np.array([1e-4, 1e-4, start[-1]]), 0.0)
        )
    )
    return SimpleNamespace(
        stops=np.arange(20),
        members=np.zeros((20, 1), dtype=int),
        seen=np.ones(1, dtype=bool),
        white=(np.array([1e-4, 1e-4]), 0.0),
        moved=lambda *_: np.zeros((20, 6, 4)),
        start_beside=lambda *_: np.array([1e-4, 1e-4, 0.1]),
        with_moves=lambda *_: extended,
    )


def test_links_that_are_off_by_many_radians_have_no_evidence():
    """Two arms between a camera and a board, whose frames take what the errors would explain."""
    basis = np.zeros((20, 6, 4))
    found = find_arm_errors(likelihood(50.0, 6e4), 0, basis)
    assert found.sigma < 2e-3
    assert not found.is_significant
    real = find_arm_errors(likelihood(3e-4, 40.0), 0, basis)
    assert real.is_significant
    np.testing.assert_allclose(real.sigma, 3e-4, rtol=1e-3)


@dataclass(frozen=True)
class Arm:
    """Blocks of errors of which the compliance of one joint alone is positive."""

    bases: Mapping[str, np.ndarray]
    tried: list[np.ndarray]
    nominal = SimpleNamespace(before=np.zeros(2))

    def slice_of(self, _: str) -> slice:
        """Place of the compliance among the errors."""
        return slice(0, 2)

    def without_least_likely(self, _: object) -> None:
        """No block is without evidence."""
        return

    def gain(self, _: object) -> float:
        """No evidence."""
        return 0.0

    def most_likely(self, logs: np.ndarray) -> SimpleNamespace:
        """Rounding is left of the joint without columns."""
        self.tried.append(logs)
        assert len(self.tried) < 3
        return SimpleNamespace(values=np.array([1e-20, -1e-3]), logs=logs)


def test_joints_whose_compliance_was_left_out_are_not_left_out_again():
    """Values of columns that are zero are those of rounding."""
    arm = Arm({COMPLIANCE: np.ones((20, 6, 2))}, [])
    best = SimpleNamespace(values=np.array([1e-3, -1e-3]), logs=np.zeros(3))
    assert _sized(arm, best) is None
    assert len(arm.tried) == 1
