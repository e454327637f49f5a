"""Names of files and features are unique."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vlagents_ray.naming import distinct, plain, without_duplicate_keys


def test_a_name_is_numbered_only_where_it_would_be_anothers() -> None:
    assert distinct(["front", "left/wrist"]) == {"front": "front", "left/wrist": "left_wrist"}
    assert distinct(["left/wrist", "left wrist", "left_wrist", "left_wrist_2"]) == {
        "left_wrist": "left_wrist",
        "left_wrist_2": "left_wrist_2",
        "left wrist": "left_wrist_3",
        "left/wrist": "left_wrist_4",
    }


@given(st.lists(st.text("ab_/ 2", min_size=1, max_size=6), unique=True))
def test_no_two_names_become_the_same_in_whatever_order_they_come(names: list[str]) -> None:
    found = distinct(names)
    assert len(set(found.values())) == len(names)
    assert distinct(reversed(names)) == found
    assert all(found[name] == name for name in names if plain(name) == name)
    assert all(plain(own) == own for own in found.values())


def test_the_second_of_a_key_is_found_among_many() -> None:
    # An algorithm with quadratic time would take an hour.
    pairs = [(str(number), number) for number in range(200_000)]
    assert len(without_duplicate_keys(pairs)) == 200_000
    with pytest.raises(ValueError, match="the key '199999' occurs twice"):
        without_duplicate_keys([*pairs, pairs[-1]])
