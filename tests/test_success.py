"""The curve of success over the delay of answers: its bounds, its tolerated delay and its file."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vlagents_ray.errors import ConfigError, InvalidInput
from vlagents_ray.policies.base.checkpoint_files import digest
from vlagents_ray.success import (
    SUCCESS_FILE,
    Solved,
    SuccessCurve,
    read_curves,
    wilson,
    write_curves,
)

CASES = settings(max_examples=200, deadline=None)


def curve(solved: dict[int, tuple[int, int, float]], **values: Any) -> SuccessCurve:
    entries = {rows: Solved(*entry) for rows, entry in solved.items()}
    fields = {"env": "tabletop", "hz": 10.0, "mode": "async", "settings": {"execute": 4}} | values
    return SuccessCurve(solved=entries, **fields)


@st.composite
def curves(draw: st.DrawFn) -> SuccessCurve:
    delays = draw(st.sets(st.integers(1, 50), max_size=6)) | {0}
    solved = {}
    for rows in delays:
        episodes = draw(st.integers(1, 1000))
        ticks = draw(st.floats(1.0, 1e4))
        solved[rows] = (draw(st.integers(0, episodes)), episodes, ticks)
    hz = draw(st.floats(0.1, 1000.0))
    values = draw(st.dictionaries(st.text(max_size=5), st.none() | st.integers() | st.booleans()))
    return curve(solved, hz=hz, settings=values, weights=draw(st.none() | st.text()))


EXAMPLE = curve({0: (492, 500, 25.0), 1: (480, 500, 26.0), 3: (380, 500, 30.0)})


def test_floor_of_known_numbers() -> None:
    # Wilson's bounds of 492 and of 380 of 500, from the formula with z = 1.96.
    assert EXAMPLE.floor(0) == pytest.approx(0.96875, abs=5e-5)
    assert EXAMPLE.floor(1) == pytest.approx(wilson(480, 500)[0])
    assert EXAMPLE.floor(3) == pytest.approx(0.72069, abs=5e-5)
    assert EXAMPLE.floor(2) == pytest.approx((EXAMPLE.floor(1) + EXAMPLE.floor(3)) / 2)
    assert EXAMPLE.floor(3.001) == EXAMPLE.floor(100) == 0.0


def test_tasks_per_hour_count_the_ticks_of_failed_episodes() -> None:
    assert EXAMPLE.tasks_per_hour(0) == pytest.approx(0.984 / 25 * 10 * 3600)
    assert EXAMPLE.tasks_per_hour(3) == pytest.approx(0.76 / 30 * 10 * 3600)
    assert EXAMPLE.tasks_per_hour(4) == 0.0


@pytest.mark.parametrize(
    ("solved", "tolerated"),
    [
        ({0: (492, 500, 25.0)}, 0),
        ({0: (492, 500, 25.0), 1: (485, 500, 25.0), 3: (380, 500, 25.0)}, 1),
        ({0: (492, 500, 25.0), 1: (380, 500, 25.0), 3: (492, 500, 25.0)}, 0),  # no gap
        ({0: (100, 500, 25.0), 3: (120, 500, 25.0)}, 3),
        ({0: (20, 20, 25.0), 1: (20, 20, 25.0)}, 0),  # too few episodes
        ({0: (0, 500, 80.0), 1: (0, 500, 80.0)}, 1),
    ],
)
def test_tolerated_delay(solved: dict[int, tuple[int, int, float]], tolerated: int) -> None:
    assert curve(solved).tolerated == tolerated


@CASES
@given(curves(), st.floats(0, 60), st.floats(0, 1))
def test_floor_lies_between_the_bounds_of_its_neighbours(
    found: SuccessCurve, rows: float, share: float
) -> None:
    floor = found.floor(rows)
    if rows > max(found.solved):
        assert floor == 0.0
        return
    shorter = max(delay for delay in found.solved if delay <= rows)
    longer = min(delay for delay in found.solved if delay >= rows)
    neighbours = sorted((found.floor(shorter), found.floor(longer)))
    assert neighbours[0] - 1e-12 <= floor <= neighbours[1] + 1e-12

    # Between two measured delays, the floor rises or falls, but not both.
    nearer = found.floor(rows + share * (longer - rows))
    assert neighbours[0] - 1e-12 <= nearer <= neighbours[1] + 1e-12
    assert (nearer - floor) * (found.floor(longer) - found.floor(shorter)) >= -1e-12


@CASES
@given(curves())
def test_bounds_and_the_tolerated_delay_agree_with_the_data(found: SuccessCurve) -> None:
    for rows, entry in found.solved.items():
        assert 0.0 <= found.floor(rows) <= entry.solved / entry.episodes + 1e-12
    tolerated = found.tolerated
    assert tolerated in found.solved
    synchronous = found.solved[0].solved / found.solved[0].episodes
    for rows in found.solved:
        if 0 < rows <= tolerated:
            assert found.floor(rows) >= 0.95 * synchronous


@CASES
@given(curves())
def test_json_returns_the_same_curve(found: SuccessCurve) -> None:
    assert SuccessCurve.from_json(json.loads(json.dumps(found.to_json()))) == found


def test_the_file_beside_a_checkpoint(tmp_path: Path) -> None:
    assert read_curves(tmp_path) == []
    (tmp_path / "model.safetensors").write_bytes(b"weights")
    before = digest([tmp_path])
    other = curve({0: (1, 2, 3.0)}, mode="open_loop")
    assert write_curves(tmp_path, [EXAMPLE, other]) == tmp_path / SUCCESS_FILE
    assert read_curves(tmp_path) == [EXAMPLE, other]
    assert digest([tmp_path]) == before, "a measurement does not change the policy"


def test_a_curve_does_not_change_with_the_callers_values() -> None:
    values, solved = {"execute": [4]}, {0: Solved(1, 2, 3.0)}
    found = SuccessCurve("tabletop", 10.0, "async", values, solved)
    values["execute"].append(5)
    solved[3] = Solved(0, 2, 3.0)
    assert found.settings == {"execute": [4]}
    assert list(found.solved) == [0]


@pytest.mark.parametrize(
    "values",
    [
        {"env": ""},
        {"env": 3},
        {"mode": None},
        {"weights": 3},
        {"hz": 0},
        {"hz": math.nan},
        {"hz": 10**400},
        {"hz": True},
        {"hz": "10"},
        {"settings": {"a": math.nan}},
        {"settings": {"a": object()}},
        {"solved": {}},
        {"solved": {1: (1, 2, 3.0)}},  # no synchronous success
        {"solved": {0: (1, 2, 3.0), 0.5: (1, 2, 3.0)}},
        {"solved": {0: (1, 2, 3.0), -1: (1, 2, 3.0)}},
        {"solved": {0: (1, 2, 3.0), "1": (1, 2, 3.0)}},
        {"solved": {0: (3, 2, 3.0)}},
        {"solved": {0: (0, 0, 3.0)}},
        {"solved": {0: (-1, 2, 3.0)}},
        {"solved": {0: (1.0, 2, 3.0)}},
        {"solved": {0: (True, 2, 3.0)}},
        {"solved": {0: (1, 10**400, 3.0)}},
        {"solved": {0: (1, 2)}},
        {"solved": {0: (1, 2, 0.0)}},
        {"solved": {0: (1, 2, math.inf)}},
        {"solved": {0: None}},
        {"solved": None},
    ],
)
def test_values_without_a_meaning_are_rejected(values: dict[str, Any]) -> None:
    good = {"env": "tabletop", "hz": 10.0, "mode": "async", "settings": {}}
    with pytest.raises(InvalidInput, match=r"expected .*, got"):
        SuccessCurve(**good | {"solved": {0: Solved(1, 2, 3.0)}} | values)


@pytest.mark.parametrize("rows", [-1, math.nan, math.inf, None, "3", True])
def test_a_delay_without_a_meaning_is_rejected(rows: Any) -> None:
    with pytest.raises(InvalidInput, match="rows: expected a delay"):
        EXAMPLE.floor(rows)
    with pytest.raises(InvalidInput, match="rows: expected a delay"):
        EXAMPLE.tasks_per_hour(rows)


@CASES
@given(st.data())
def test_a_changed_document_is_a_curve_or_an_error(data: st.DataObject) -> None:
    document = EXAMPLE.to_json()
    garbage = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.just([])
    target = data.draw(st.sampled_from([document, *document["delays"]]))
    name = data.draw(st.sampled_from([*target, "unknown"]))
    if data.draw(st.booleans()):
        target[name] = data.draw(garbage)
    else:
        target.pop(name, None)
    try:
        found = SuccessCurve.from_json(document)
    except InvalidInput:
        return
    assert found.tolerated in found.solved


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"curves": [{}]}', '{"curves": 3}', "[" * 10**5, '{"curves": [3]}']
)
def test_a_file_that_is_not_one_of_curves_names_the_cure(tmp_path: Path, text: str) -> None:
    (tmp_path / SUCCESS_FILE).write_text(text)
    with pytest.raises(ConfigError, match="measure them again"):
        read_curves(tmp_path)


def test_each_delay_stands_once_in_a_document() -> None:
    document = EXAMPLE.to_json()
    document["delays"].append(document["delays"][1])
    with pytest.raises(InvalidInput, match="each number of rows once"):
        SuccessCurve.from_json(document)
