"""Protocols, as results record them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from vlagents_ray.envs.simulator import BenchmarkProtocol
from vlagents_ray.registry import ENVS
from vlagents_ray.testing.comparing import require_wireable

PAGES = Path(__file__).parents[2] / "docs" / "benchmarks"
ANY_PROTOCOL = {"tabletop", "gymnasium"}  # our own example, and environments of others by their ids

PROTOCOL = BenchmarkProtocol(
    name="Shelf",
    source="a paper",
    max_steps=200,
    control_hz=20.0,
    control="joints",
    success="it is on the shelf",
    begins="the seed's",
    ends_on_success=True,
)


def test_what_was_played_by_the_protocol_deviates_in_nothing() -> None:
    assert PROTOCOL.describe(max_steps=200, control_hz=20)["deviations"] == []


def test_each_deviation_is_told_with_what_the_protocol_says() -> None:
    told = PROTOCOL.describe(max_steps=50, control_hz=20.0, ends_on_success=False)["deviations"]
    assert told == ["max_steps: 50, the protocol says 200", "ends_on_success: False, the protocol says True"]


def test_a_description_travels_in_a_result() -> None:
    described = replace(PROTOCOL, episodes=50).describe(max_steps=1)
    require_wireable(described, "describe()")
    assert (described["name"], described["episodes"]) == ("Shelf", 50)


def test_what_a_protocol_does_not_settle_cannot_deviate_from_it() -> None:
    with pytest.raises(AttributeError, match="colour"):
        PROTOCOL.describe(colour="red")


@pytest.mark.parametrize("suite", sorted(set(ENVS) - ANY_PROTOCOL))
def test_the_page_of_a_benchmark_states_its_protocol(suite: str) -> None:
    page = (PAGES / f"{'rcs' if suite == 'duobench' else suite}.md").read_text()
    section = re.search(r"^## Protocol\n(.*?)(?=^## |\Z)", page, re.DOTALL | re.MULTILINE)
    assert section is not None
    for stated in ("step", "success"):
        assert stated in section[1].lower()
