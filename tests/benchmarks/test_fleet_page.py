"""The table and the picture of several fleet measurements."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.fleet_page import markdown, merge_fleets, most
from benchmarks.picture import plot_fleets

PLAN: dict[str, Any] = {
    "kinds": [{"hz": 10.0, "rows": 50, "weight": 1}],
    "chunk": 50,
    "base_ms": 29.3,
    "row_ms": 8.06,
    "batch": 16,
    "transport": "websocket",
    "real_time_chunking": False,
    "link": None,
    "delay": None,
}


def point(system: str, robots: int, served: int) -> dict[str, Any]:
    return {
        "system": system,
        "robots": robots,
        "served": served,
        "share": served / robots,
        "age_p95_ms": 1200.0,
        "server_cpu_s": 5.0,
        "client_cpu_s": 13.0,
    }


def test_files_of_the_same_robots_share_a_panel(tmp_path: Path) -> None:
    mixed = {**PLAN, "kinds": [*PLAN["kinds"], {"hz": 10.0, "rows": 8, "weight": 1}]}
    files: list[dict[str, Any]] = [
        {"plan": PLAN, "points": [point("vlagents_ray", 64, 64), point("vlagents_ray", 256, 192)]},
        {"plan": PLAN, "points": [point("openpi", 64, 32)]},
        {"plan": mixed, "points": [point("vlagents_ray", 32, 32)]},
    ]
    fleets = merge_fleets(files)
    assert [len(fleet["points"]) for fleet in fleets] == [3, 1]
    assert [fleet["most"] for fleet in fleets] == [426, None]

    ours, openpi, _ = markdown(fleets).splitlines()[2:]
    assert "| vlagents_ray | 64 | 64: 100.0%, 64, 1.20; 256: 75.0%, 192, 1.20 | 5, 13 |" in ours
    assert "| openpi | 0 |" in openpi

    picture = tmp_path / "fleet.svg"
    plot_fleets(fleets, picture)
    assert "openpi" in picture.read_text()
    assert "chunks of 50 actions at 10 Hz" in picture.read_text()


def test_another_rate_is_another_fleet() -> None:
    slower = {**PLAN, "kinds": [{"hz": 5.0, "rows": 50, "weight": 1}]}
    fleets = merge_fleets([{"plan": PLAN, "points": []}, {"plan": slower, "points": []}])
    assert len(fleets) == 2
    assert most(slower) > most(PLAN)  # type: ignore[operator]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"transport": "http"}, "http, 29.3 ms"),
        ({"real_time_chunking": True}, "websocket, RTC, 29.3"),
        ({"link": "1gbit"}, "websocket, link of 1gbit, 29.3"),
        ({"link": "1gbit", "delay": "2ms"}, "websocket, link of 1gbit and 2ms, 29.3"),
    ],
)
def test_robots_that_are_reached_in_another_way_are_another_fleet(
    changes: dict[str, Any], text: str
) -> None:
    other = {**PLAN, **changes}
    fleets = merge_fleets([{"plan": PLAN, "points": []}, {"plan": other, "points": []}])
    assert len(fleets) == 2
    assert text in fleets[1]["title"]


def test_many_fleets_have_several_rows_of_panels(tmp_path: Path) -> None:
    plans = [{**PLAN, "kinds": [{"hz": hz, "rows": 50, "weight": 1}]} for hz in (1, 2, 5, 10)]
    files: list[dict[str, Any]] = [
        {"plan": plan, "points": [point("vlagents_ray", 8, 8)]} for plan in plans
    ]
    picture = tmp_path / "fleets.svg"
    plot_fleets(merge_fleets(files), picture)
    assert picture.read_text().count("ticks in time") == 4
