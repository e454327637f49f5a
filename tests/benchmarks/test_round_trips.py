"""Which ways are measured, which are not and why; and that they take turns."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from benchmarks.drivers import Driver
from benchmarks.own_clients import OWN_CLIENTS, connect, observation, own_clients
from benchmarks.round_trips import ROUND, in_turns
from vlagents_ray.errors import ConfigError
from vlagents_ray.images.jpeg_png import encode_jpeg


class Turns:
    """Notes whose turn it is."""

    def __init__(self, name: str, log: list[str]) -> None:
        self.name, self.log = name, log

    def ready(self) -> dict[str, object]:
        return {}

    def measure(self, calls: int) -> list[float]:
        self.log.append(self.name)
        return [float(len(self.log))] * calls


def test_the_observation_compresses_as_a_photograph_does() -> None:
    image = observation().cameras["camera_0"]
    assert 0.05 < len(encode_jpeg(image)) / image.nbytes < 0.5


def test_all_take_turns_in_short_rounds_and_nobody_is_always_the_first() -> None:
    log: list[str] = []
    drivers: Mapping[str, Driver] = {name: Turns(name, log) for name in "abc"}
    found = in_turns(drivers, 3 * ROUND - 15, lambda _: None)
    assert {name: trips.rounds.shape for name, trips in found.items()} == dict.fromkeys("abc", (3, ROUND))
    assert [sorted(log[i : i + 3]) for i in (0, 3, 6)] == [["a", "b", "c"]] * 3
    assert len(set(log[::3])) > 1
    assert in_turns(drivers, 10, lambda _: None)["a"].rounds.shape == (1, 10)


def test_ways_have_names_of_their_own() -> None:
    assert len({way.name for way in OWN_CLIENTS}) == len(OWN_CLIENTS)
    found, skipped = own_clients()
    assert {way.name for way in found} | set(skipped) == {way.name for way in OWN_CLIENTS}
    assert [way.transport for way in own_clients(["shm"])[0]] == ["shm", "shm"]
    with pytest.raises(ConfigError, match="carrier pigeon"):
        own_clients(["carrier pigeon"])


def test_a_codec_is_written_in_words() -> None:
    assert connect("http://127.0.0.1:1", "websocket", "jpeg 90 420", rank="robot").transport == "websocket"
    with pytest.raises(ValueError, match="codec"):
        connect("http://127.0.0.1:1", "websocket", "gif")
