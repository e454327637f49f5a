"""Round trips: which transports are measured in turn, and the medians, intervals and ratios of
known data.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
import pytest

from benchmarks.drivers import Driver
from benchmarks.figures import (
    RoundTrips,
    lost_db,
    measured_on,
    median_interval,
    median_ratio,
    ratios,
)
from benchmarks.own_clients import OWN_CLIENTS, observation, own_clients
from benchmarks.processes import DAEMONS
from benchmarks.round_trips import ROUND, in_turns, measure
from vlagents_ray.errors import ConfigError
from vlagents_ray.images.jpeg_png import encode_jpeg


class Turns:
    """A transport that records the order of its measurements."""

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
    assert {name: trips.rounds.shape for name, trips in found.items()} == dict.fromkeys(
        "abc", (3, ROUND)
    )
    assert [sorted(log[i : i + 3]) for i in (0, 3, 6)] == [["a", "b", "c"]] * 3
    assert len(set(log[::3])) > 1
    assert in_turns(drivers, 10, lambda _: None)["a"].rounds.shape == (1, 10)


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.server
@pytest.mark.alone
def test_what_an_act_uses_is_counted_by_client_and_server() -> None:
    ways = own_clients(["shm", "http"])
    found = measure(ways, 300, lambda _: None).to_json()["use"]
    assert set(found) == {way.name for way in ways}
    for way in ways:
        client, server = (found[way.name][part] for part in ("client", "server"))
        assert client["cpu_ms"] > 0
        assert server["programs"]["ServeReplica"] > 0
        assert server["cpu_ms"] == pytest.approx(sum(server["programs"].values()))
        assert not DAEMONS & set(server["programs"])
    assert found["http, jpeg"]["server"]["cpu_ms"] > found["shm"]["server"]["cpu_ms"]


def test_ways_have_names_of_their_own() -> None:
    assert len({way.name for way in OWN_CLIENTS}) == len(OWN_CLIENTS)
    assert own_clients() == list(OWN_CLIENTS)
    assert [way.transport for way in own_clients(["shm"])] == ["shm", "shm"]
    with pytest.raises(ConfigError, match="carrier pigeon"):
        own_clients(["carrier pigeon"])


def trips(name: str, median: float, rounds: int = 20, seed: int = 0) -> RoundTrips:
    return RoundTrips(
        name, np.random.default_rng(seed).lognormal(np.log(median), 0.2, (rounds, 25))
    )


def test_the_interval_holds_the_median() -> None:
    numbers = np.arange(1, 102, dtype=float)
    assert median_interval(numbers) == (41, 62)  # order statistics of 101 calls at 95 %
    assert median_interval(np.array([3.0])) == (3, 3)
    one = RoundTrips("x", numbers.reshape(1, -1))
    assert one.median == 51
    assert one.to_json() == {
        "way": "x",
        "calls": 101,
        "median_ms": 51,
        "ci95_ms": [41, 62],
        "p99_ms": 100,
    }


def test_a_ratio_lies_in_its_interval_and_the_truth_does_too() -> None:
    found = median_ratio(trips("a", 1.0), trips("b", 4.0, seed=1))
    assert found.low < found.ratio < found.high
    assert found.low < 0.25 < found.high
    assert found.high - found.low < 0.05


@pytest.mark.slow
def test_the_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    hits = 0
    for seed in range(40):
        found = median_ratio(trips("a", 1.0, seed=2 * seed), trips("b", 2.0, seed=2 * seed + 1))
        hits += found.low <= 0.5 <= found.high
    assert hits >= 33  # 95 % of 40 is 38; 33 or fewer has a probability under 1 %


def test_what_slows_both_down_does_not_widen_the_ratio() -> None:
    # The machine becomes three times slower, in the same way for both.
    load = np.linspace(1, 3, 20)[:, None]
    a, b = trips("a", 1.0), trips("b", 2.0, seed=1)
    found = median_ratio(RoundTrips("a", a.rounds * load), RoundTrips("b", b.rounds * load))
    assert found.low < 0.5 < found.high
    assert found.high - found.low < 0.1


def test_only_what_was_measured_in_one_run_is_compared() -> None:
    with pytest.raises(ValueError, match="one run"):
        median_ratio(trips("a", 1.0), trips("b", 1.0, rounds=3))


def test_every_one_of_ours_is_compared_with_every_one_of_theirs() -> None:
    found = ratios([trips("a", 1.0), trips("b", 2.0)], [trips("c", 1.0)])
    assert {ours: list(theirs) for ours, theirs in found.items()} == {"a": ["c"], "b": ["c"]}
    assert found["a"]["c"]["ratio"] == 1


def test_what_images_lost() -> None:
    sent = {"front": np.full((4, 4, 3), 100, np.uint8)}
    assert lost_db(sent, sent) is None
    # 20 log10(255)
    assert lost_db({"front": sent["front"] + np.uint8(1)}, sent) == pytest.approx(48.13, abs=0.01)


def test_what_figures_depend_on_is_json_without_names_of_hosts() -> None:
    said = json.loads(json.dumps(measured_on("python -m benchmarks.rtt")))
    assert said.keys() == {"date", "command", "machine", "versions"}
    assert said["versions"].keys() >= {"vlagents-ray", "numpy", "Python"}
    assert said["machine"].keys() == {"cpu", "cores", "memory_gb", "kernel", "load"}
