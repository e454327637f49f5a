"""The figures of the events of a fleet."""

from __future__ import annotations

import pytest

from benchmarks.fleet_events import Event, summary


def test_an_event_counts_the_ticks_until_the_next_one() -> None:
    killed = Event("a replica killed", 10.0, 20)
    # Before the event, in its first and its third second, and after the next event.
    late = [9.9, *([10.2] * 50), *([12.5] * 5), 40.0]
    figures = summary(killed, 40.0, late, hz=10.0)
    assert figures["starved"] == 55
    assert figures["share"] == pytest.approx(1 - 55 / 6000)
    assert figures["worst_second"] == pytest.approx(1 - 50 / 200)
    assert figures["in_time_again_s"] == 3, "2.5 % of the third second's ticks were missed"


def test_an_event_without_a_late_tick_was_in_time_at_once() -> None:
    figures = summary(Event("steady", 5.0, 8), 10.0, [4.9], hz=10.0)
    assert (figures["share"], figures["worst_second"], figures["in_time_again_s"]) == (1.0, 1.0, 0)
