"""The benchmark of round trips measures every way to the policy."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray.bench.rtt import WAYS, RoundTrips, measure_rtt, observation


def test_the_interval_holds_the_median() -> None:
    trips = RoundTrips("x", np.arange(1, 102, dtype=float))
    low, high = trips.interval
    assert trips.median == 51
    assert (low, high) == (41, 62)  # order statistics of 101 calls at 95 %
    assert RoundTrips("x", np.array([3.0])).interval == (3, 3)


def test_the_observation_compresses_as_a_photograph_does() -> None:
    from vlagents_ray.images import encode_jpeg

    image = observation().cameras["camera_0"]
    assert 0.05 < len(encode_jpeg(image)) / image.nbytes < 0.5


@pytest.mark.slow
def test_every_way_is_measured_and_shared_memory_is_the_fastest() -> None:
    found = {trips.name: trips for trips in measure_rtt(calls=60)}
    assert set(found) == {way.name for way in WAYS}
    assert all(len(trips.ms) == 60 for trips in found.values())
    assert min(found, key=lambda name: found[name].median) == "shm"
