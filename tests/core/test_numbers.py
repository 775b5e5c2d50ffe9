"""Transforms, quantiles, and figures as messages and pages state them."""

from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2, f, t
from support.refusals import raised
from support.slopes import jacobian
from typing_extensions import TypeAliasType

import visioncal
from visioncal.core import transforms
from visioncal.core.codec import read_value
from visioncal.core.errors import DataError
from visioncal.core.limits import CalibrationLimits, NeedLimits
from visioncal.core.number_format import figure, rounded_up, sigma_words, significant
from visioncal.core.quantiles import chi2_limit, f_limit, root_of, t_chance
from visioncal.core.types import FloatArray, evenly, scalar_of
from visioncal.robot.model import REPEATABILITY


@pytest.fixture
def poses():
    rng = np.random.default_rng(4)
    rotation = Rotation.random(30, rng=rng).as_matrix()
    return transforms.compose(rotation, rng.normal(size=(30, 3)))


def test_invert_undoes_and_agrees_with_scipy(poses):
    # Products of matrices of order one in double precision.
    np.testing.assert_allclose(
        transforms.invert(poses) @ poses, np.tile(np.eye(4), (30, 1, 1)), atol=1e-14
    )
    expected = RigidTransform.from_matrix(poses).inv().as_matrix()
    np.testing.assert_allclose(transforms.invert(poses), expected, atol=1e-14)


def test_exp_and_log_undo_each_other(poses):
    np.testing.assert_allclose(transforms.exp(transforms.log(poses)), poses, atol=1e-12)


def test_adjoint_carries_a_twist_to_the_other_side(poses):
    twist = np.random.default_rng(5).normal(size=(30, 6))
    carried = (transforms.adjoint(poses) @ twist[:, :, None])[:, :, 0]
    np.testing.assert_allclose(
        transforms.exp(carried) @ poses, poses @ transforms.exp(twist), atol=1e-12
    )


def test_inverse_right_jacobian_agrees_with_central_differences():
    rng = np.random.default_rng(6)
    twists = rng.uniform(-1, 1, (20, 6))
    twists[:, :3] *= 0.5 / np.linalg.norm(twists[:, :3], axis=1, keepdims=True)

    def moved(by):
        return transforms.log(transforms.exp(twists) @ transforms.exp(by))

    # Truncation step^2 = 1e-10 and rounding 1e-16 / step = 1e-11, times terms of order ten.
    slopes = jacobian(moved, 6, 1e-5)
    np.testing.assert_allclose(transforms.inverse_right_jacobian(twists), slopes, atol=2e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, np.pi - 1e-9, np.pi])
def test_rotation_angle_is_exact_at_both_ends(angle):
    rotation = Rotation.from_rotvec([0.0, angle * 0.6, angle * 0.8]).as_matrix()
    # arctan2 of sine and cosine loses nothing at 0; at pi the sine's rounding is the angle's.
    assert transforms.rotation_angle(rotation) == pytest.approx(angle, abs=1e-15)


def test_nearest_rotation_repairs_and_never_reflects(poses):
    rotation = poses[:, :3, :3]
    np.testing.assert_allclose(transforms.nearest_rotation(2.5 * rotation), rotation, atol=1e-13)
    mirrored = rotation @ np.diag([1.0, 1.0, -1.0])
    assert np.all(np.linalg.det(transforms.nearest_rotation(mirrored)) > 0.999)


def test_mean_transform_of_a_symmetric_pair_is_the_middle(poses):
    twist = np.array([0.1, -0.2, 0.05, 0.0, 0.0, 0.0])
    pair = np.stack([poses[0] @ transforms.exp(twist), poses[0] @ transforms.exp(-twist)])
    np.testing.assert_allclose(transforms.mean_transform(pair), poses[0], atol=1e-14)


CHANCES = (0.5, 0.05, 1e-4, 1e-9)


# Two ways to the same quantile: a few thousand units in the last place.
def test_a_root_lies_within_the_tolerance():
    evaluated = []

    def found(rising, root):
        evaluated.clear()
        at = root_of(lambda value: evaluated.append(value) or rising(value), -30.0, 2.0, 1e-9)
        assert abs(at - root) < 1e-9

    # Halving takes 35 evaluations.
    found(lambda value: np.tanh(value - 1.03), 1.03)
    assert len(evaluated) < 20
    for steep in (lambda value: (value - 0.3) ** 9, lambda value: 1.0 if value > 0.3 else -1e-3):
        found(steep, 0.3)
        assert len(evaluated) < 140
    # Where a function has no root, the bound that is nearest to one.
    found(lambda _: 1.0, -30.0)
    found(lambda _: -1.0, 2.0)


@pytest.mark.parametrize("chance", CHANCES)
def test_limits_are_the_distributions_upper_quantiles(chance):
    freedoms = np.array([1, 6, 40, 300])
    assert chi2_limit(chance, freedoms) == pytest.approx(chi2.isf(chance, freedoms), rel=1e-9)
    for of_noise in (3, 50, 1e6):
        expected = f.isf(chance, freedoms, of_noise)
        assert f_limit(chance, freedoms, of_noise) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("value", [-3.0, 0.0, 0.7, 20.0])
def test_chance_counts_both_sides(value):
    assert t_chance(value, 4) == pytest.approx(2 * t.sf(abs(value), 4), rel=1e-9)


PAGE = Path(visioncal.__file__).parent / "calibration" / "README.md"


def _row(status):
    (row,) = (line for line in PAGE.read_text().splitlines() if line.startswith(f"| `{status}` |"))
    return row


def test_the_page_states_where_doubt_begins_and_where_trust_ends():
    limits, (met, half) = CalibrationLimits(), NeedLimits().probability
    (scatter_mm, lost_mm), (scatter_deg, lost_deg) = limits.scatter_mm, limits.scatter_deg
    (sigma_mm, bad_mm), (sigma_deg, bad_deg) = limits.sigma_mm, limits.sigma_deg
    assert f"with {100 * met:g} % or more" in _row("good")
    assert f"under {scatter_mm:g} mm and {scatter_deg:g} deg" in _row("good")
    assert f"known to {sigma_mm:g} mm and {sigma_deg:g} deg" in _row("good")
    robot_mm, robot_deg = (limits.repeatability * value for value in REPEATABILITY)
    assert f"under {robot_mm:g} mm and {robot_deg:g} deg" in _row("good")
    assert f"corners under {limits.pixel_px[0]:g} px, {limits.stops[0]} stops" in _row("good")
    assert f"{100 * (1 - limits.lost_share[0]):g} % of the views" in _row("good")
    assert f"with {100 * half:g} % or more" in _row("check")
    assert f"{lost_mm:g} mm and {lost_deg:g} deg, {bad_mm:g} mm and {bad_deg:g} deg" in _row("bad")
    assert f"{limits.pixel_px[1]:g} px, under {limits.stops[1]} stops" in _row("bad")
    assert f"under {100 * (1 - limits.lost_share[1]):g} % of the views" in _row("bad")


@pytest.mark.parametrize(
    ("limit", "shown"),
    [
        (0.1414, "0.15"),
        (0.14, "0.14"),
        (0.0991, "0.1"),
        (9.91, "10"),
        (12.1, "13"),
        (123.2, "124"),
        (0.0, "0"),
        (float("inf"), "inf"),
    ],
)
def test_a_limit_is_rounded_up_to_the_digits_shown(limit, shown):
    assert figure(rounded_up(limit)) == shown
    assert float(significant(rounded_up(limit))) == float(shown) >= limit


def test_annotations_of_arrays_are_read_in_the_form_of_newer_numpy_too(monkeypatch):
    assert scalar_of(FloatArray) is np.float64
    assert scalar_of(tuple[int, int]) is None
    # NumPy 2.5 declares it as `type NDArray[S] = ndarray[tuple[Any, ...], dtype[S]]`.
    scalar = TypeVar("scalar", bound=np.generic)
    declared = np.ndarray[Any, np.dtype[scalar]]
    alias = TypeAliasType("NDArray", declared, type_params=(scalar,))
    monkeypatch.setattr(npt, "NDArray", alias)
    assert scalar_of(alias[np.uint8]) is np.uint8


def test_a_sigma_beyond_all_cells_is_called_not_determined():
    assert sigma_words(0.123, "mm") == "0.12 mm"
    assert sigma_words(3.9e12, "mm") == "not determined (mm)"
    assert sigma_words(250.0, "deg") == "not determined (deg)"
    assert sigma_words(float("inf"), "deg") == "not determined (deg)"


@pytest.mark.parametrize(("count", "chosen"), [(-2, []), (0, []), (1, [0]), (5, [0, 2, 4])])
def test_numbers_are_chosen_evenly_and_none_of_an_empty_range(count, chosen):
    # A robot that never moved has one stop, and a change needs two on either side of it.
    assert evenly(count, 3).tolist() == chosen


@pytest.mark.parametrize(
    ("kind", "value", "step"),
    [
        (float, "0.123456789", "Write it without quotes: 0.123456789."),
        (float, " 1234567 ", "Write it without quotes: 1234567."),
        (Literal[1], "1", "Write it without quotes: 1."),
        (Literal["one", "two"], "1", ""),
        (int, "3.5", ""),
        (float, "nan", ""),
        (float, "one", ""),
        (bool, "1", ""),
        (str, 1, ""),
    ],
)
def test_a_number_in_quotes_is_to_be_written_as_it_is_where_it_would_pass(kind, value, step):
    assert raised(DataError, "x is", read_value, kind, value, "x").next_step == step
