"""Numbers as messages print them."""

import pytest

from visioncal.core.number_format import counted, figure, rounded_up, significant


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


def test_a_count_of_one_is_singular():
    verbs = ("shows", "show")
    assert [counted(count, "view", verbs) for count in (0, 1, 3)] == [
        "0 views show",
        "1 view shows",
        "3 views show",
    ]
    assert counted(1, "pose") == "1 pose"
