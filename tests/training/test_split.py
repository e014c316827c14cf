"""The split: the same for a recording whatever else there is, and never through a group."""

from __future__ import annotations

import pytest

from eqrt.core.errors import EqrtError
from eqrt.training.dataset.split import Split, split_of

GROUPS = [f"drive-{number}" for number in range(10_000)]


def held_out(split: Split, groups: list[str]) -> set[str]:
    sides = split.sides([(group, group) for group in groups])
    return {group for group, side in zip(groups, sides, strict=True) if side == "val"}


def test_the_sides_of_these_groups_never_change() -> None:
    """A model trained with last year's eqrt must not meet its training data in this year's."""
    drawn = "".join(split_of(group, 0, 0.2)[0] for group in GROUPS[:40])
    assert drawn == "tttvtttttttttttttttttttttttvttvtttttttvt"


def test_a_side_depends_neither_on_order_nor_on_what_else_there_is() -> None:
    few = held_out(Split(), GROUPS[100:200])
    assert few == held_out(Split(), GROUPS[199:99:-1])
    assert few == held_out(Split(), GROUPS) & set(GROUPS[100:200])


def test_about_the_share_asked_for_is_held_out() -> None:
    for share in (0.05, 0.2, 0.5):
        found = len(held_out(Split(held_out_share=share), GROUPS)) / len(GROUPS)
        assert found == pytest.approx(share, abs=0.02)  # 4 standard deviations at 0.5


def test_nothing_or_everything_can_be_held_out() -> None:
    assert not held_out(Split(held_out_share=0.0), GROUPS)
    assert held_out(Split(held_out_share=1.0), GROUPS) == set(GROUPS)


def test_who_holds_out_more_holds_out_the_same_and_more() -> None:
    assert held_out(Split(), GROUPS) < held_out(Split(held_out_share=0.3), GROUPS)


def test_another_seed_is_another_split() -> None:
    one, other = held_out(Split(seed=1), GROUPS), held_out(Split(seed=2), GROUPS)
    assert len(one & other) / len(GROUPS) == pytest.approx(0.04, abs=0.01)  # independent


def test_recordings_of_one_group_are_on_one_side() -> None:
    recordings = [(f"{group}/{number}", group) for group in GROUPS[:50] for number in range(3)]
    sides = Split(held_out_share=0.5).sides(recordings)
    assert sides == [side for first in sides[::3] for side in [first] * 3]


def test_what_is_named_is_held_out_with_its_group_and_nothing_else() -> None:
    recordings = [("a1", "a"), ("a2", "a"), ("b1", "b"), ("c1", "c")]
    assert Split(held_out=("a2",)).sides(recordings) == ["val", "val", "train", "train"]
    assert Split(held_out=("c", "b1")).sides(recordings) == ["train", "train", "val", "val"]


def test_holding_out_what_is_not_there_is_an_error_that_names_it() -> None:
    with pytest.raises(EqrtError, match="held out is 'd1', which is no recording or group here"):
        Split(held_out=("a", "d1")).sides([("a1", "a")])


def test_what_is_held_out_elsewhere_is_not_missed_here() -> None:
    split = Split(held_out=("a", "d1"), others_elsewhere=True)
    assert split.sides([("a1", "a"), ("b1", "b")]) == ["val", "train"]
    assert split.sides([("b1", "b")]) == ["train"]


def test_a_share_is_between_0_and_1() -> None:
    with pytest.raises(ValueError, match=r"1\.5, expected 0 to 1"):
        Split(held_out_share=1.5)
