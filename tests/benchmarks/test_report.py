"""docs/measured_tables.md is generated from the figures alone."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks.further_tables import FILE, read_tables, replace_rows
from benchmarks.picture import plot_league, plot_throughput
from benchmarks.report import DEFAULT, JPEG, _skipped, outcomes, page_text, section

ROOT = Path(__file__).parents[2]


def way(name: str, ms: float, psnr: float | None = None) -> dict[str, Any]:
    return {
        "way": name,
        "calls": 500,
        "median_ms": ms,
        "ci95_ms": [ms, ms + 0.01],
        "p99_ms": 2 * ms,
        "psnr_db": psnr,
    }


def use(ms: float) -> dict[str, Any]:
    programs = {"haproxy": 0.25 * ms, "ServeReplica": 0.75 * ms, "HAProxyManager": 0.001 * ms}
    return {
        "cpu_ms": ms,
        "voluntary_switches": 2.0,
        "involuntary_switches": 0.04,
        "programs": programs,
    }


def round_trips(ours: dict[str, float], theirs: dict[str, float]) -> dict[str, Any]:
    ratios = {
        a: {b: {"ratio": x / y, "ci95": [x / y - 0.01, x / y + 0.01]} for b, y in theirs.items()}
        for a, x in ours.items()
    }
    ways = [way(name, ms, 33.0 if "jpeg" in name else None) for name, ms in ours.items()]
    return {
        "ways": ways,
        "peers": [way(name, ms) for name, ms in theirs.items()],
        "ratios": ratios,
        "skipped": {},
    }


THEIRS = {"vlagents shm": 0.5, "vlagents JPEG": 2.0, "openpi": 0.6, "OpenVLA REST": 3.0}
RESULTS: dict[str, Any] = {
    "date": "2026-01-02",
    "command": "python -m benchmarks.report",
    "machine": {"cpu": "a CPU", "cores": 2, "memory_gb": 24, "kernel": "6.1", "load": 0.1},
    "versions": {"ray": "2.60.0", "vlagents": "0.3.0"},
    "skipped": {},
    "rtt": {
        **round_trips(
            {
                "plasma, Ray actor": 0.15,
                "shm": 0.11,
                JPEG: 1.2,
                DEFAULT: 0.28,
                "websocket, raw": 0.45,
                "http, jpeg": 1.7,
            },
            THEIRS,
        ),
        "skipped": {"vla-eval": "not installed"},
        "use": {
            name: {"client": use(1.25), "server": use(ms)}
            for name, ms in (("http, jpeg", 0.8), ("openpi", 0.5))
        },
        "steady": [way("plasma, Ray actor", 0.1), {**way("shm", 0.1), "p99_ms": 0.31}],
    },
    "link": {
        **round_trips({"websocket, default": 0.9}, {"vlagents JPEG": 2.0, "openpi": 2.5}),
        "link": {"measured_mbit_per_s": 953.2},
    },
    "throughput": {
        "policy": "noop",
        "config": {"base_ms": 20.0},
        "batch": 16,
        "clients": 32,
        "ideal_actions_per_s": 444.4,
        "ideal_is": "by arithmetic",
        "skipped": {},
        "transports": {
            "shm": {
                "actions_per_s": 400.0,
                "of_ideal": 0.9,
                "curve": [{"clients": 32, "actions_per_s": 400.0}],
                "robot": {"wait_p50_ms": 20.0, "wait_p99_ms": 40.0},
            },
        },
        "peers": {
            "openpi": {
                "of_ideal": 0.1,
                "robot": None,
                "curve": [
                    {"clients": k, "actions_per_s": 47.1, "ci95": [46.0, 48.2]} for k in (8, 32)
                ],
            },
        },
    },
}


def test_each_target_is_judged_by_its_figure() -> None:
    found = {(one.what, one.wanted): one for one in outcomes(RESULTS)}
    node = found["a Ray env actor and the replica on its node (plasma)", "≤ 0.20 x vlagents shm"]
    assert (node.measured, node.met) == ("0.300 (0.290 to 0.310)", False)
    # 0.11 / 0.5.
    assert not found["a local process and the replica (shm)", "≤ 0.10 x vlagents shm"].met
    assert not found["a local process and the replica (shm)", "≤ 0.12 x openpi"].met  # 0.11 / 0.6
    assert found["WebSocket, raw", "≤ 0.80 x openpi"].met  # 0.45 / 0.6
    assert found["Serve handle", "≤ 1.00 x vlagents JPEG"].met is None
    assert found["WebSocket, our default, over the link", "≤ 0.45 x openpi"].met
    assert not found["actions a second, 32 sessions, batches of 16, shm", "≥ 0.98 of the ideal"].met
    assert (
        found["actions a second, 32 sessions, batches of 16, plasma", "≥ 0.98 of the ideal"].met
        is None
    )
    assert found["a robot's wait among 31 simulations, shm", "p99 ≤ 72 ms"].met
    tails = [one for one in found.values() if one.what.startswith("p99 over median, ")]
    assert [(one.measured, one.met) for one in tails] == [("2.0", True), ("3.1", False)]


def test_a_default_that_loses_more_of_the_image_does_not_meet_its_target() -> None:
    worse = copy.deepcopy(RESULTS)
    worse["rtt"]["ways"][3]["psnr_db"] = 30.0
    for results, met in ((RESULTS, True), (worse, False)):
        (line,) = [one for one in outcomes(results) if one.what == "WebSocket, our default setting"]
        assert line.met is met


def test_the_section_names_machine_date_versions_and_command() -> None:
    text = section(RESULTS)
    for part in (
        "2026-01-02",
        "`python -m benchmarks.report`",
        "a CPU, 2 cores",
        "ray 2.60.0",
        "vla-eval (not installed)",
    ):
        assert part in text
    assert "| shm | 0.110 (0.110 to 0.120) | 0.22 | 1 | 400 | 20.0 / 40.0 |  |  |" in text
    assert "| *openpi* | 0.600 (0.600 to 0.610) | 1.20 | 5.45 | 47 (46 to 48) |  |  |  |" in text
    assert "| *openpi* | 0.100 | 47 (46 to 48) | 47 (46 to 48) |  |" in text
    assert "a link of 953 Mbit/s" in text
    openpi = (
        "| openpi | 1.250 | 0.500 | 2000 | ServeReplica 0.375, haproxy 0.125 | 2.0 | 2.0 | 0.1 |"
    )
    assert openpi in text
    assert text.index(openpi) < text.index("| http, jpeg | 1.250 | 0.800 | 1250 |")


def test_what_was_not_measured_is_said() -> None:
    text = section(
        {
            **RESULTS,
            "rtt": None,
            "link": None,
            "throughput": None,
            "skipped": {"link": "no right to"},
        }
    )
    assert "link (no right to)" in text


def test_every_row_of_a_table_has_as_many_cells_as_its_head() -> None:
    cells = 0
    for line in section(RESULTS).splitlines():
        if not line.startswith("|"):
            cells = 0
            continue
        cells = cells or line.count("|")
        assert line.count("|") == cells


def test_the_picture_has_all_systems(tmp_path: Path) -> None:
    results = {**RESULTS, "without_gain": None}
    for file in (tmp_path / "one.svg", tmp_path / "two.svg"):
        plot_league(results, file)
    text = (tmp_path / "one.svg").read_text()
    assert text == (tmp_path / "two.svg").read_text()
    for name in ("openpi", "vlagents, JPEG", "plasma, from a Ray actor"):
        assert name in text
    plot_throughput(results, tmp_path / "throughput.svg")
    text = (tmp_path / "throughput.svg").read_text()
    for name in ("openpi", "actions/s", "batches of 16", "possible"):
        assert name in text


def test_the_colours_of_a_picture_follow_the_scheme_of_the_reader(tmp_path: Path) -> None:
    plot_league(RESULTS, tmp_path / "league.svg")
    text = (tmp_path / "league.svg").read_text()
    style, _, drawing = text.partition("</style>")
    assert "prefers-color-scheme:dark" in style
    assert re.findall(r"(?:fill|stroke): #\w+", drawing) == []
    assert "Bitstream" not in drawing


def test_the_page_follows_from_the_figures() -> None:
    results = json.loads((ROOT / "benchmarks" / "latest.json").read_text())
    page = (ROOT / "docs" / "measured_tables.md").read_text()
    assert page == page_text(results, read_tables()), "run python -m benchmarks.report --from-json"


def test_a_new_measurement_replaces_the_table_of_its_title(tmp_path: Path) -> None:
    file = tmp_path / "tables.json"
    file.write_text(FILE.read_text())
    first, *others = read_tables(file)
    replace_rows(first.title, ["robots", "ms"], [["1", "2.5"]], "2026-12-01", file)
    changed, *unchanged = read_tables(file)
    assert unchanged == others
    assert f"(`{first.command}`, 2026-12-01):\n\n| robots | ms |" in changed.to_markdown()
    with pytest.raises(KeyError, match="other"):
        replace_rows("other", [], [], "2026-12-01", file)


def test_a_system_is_listed_once_for_each_measurement_that_lacks_it() -> None:
    """Two parts of the benchmark used different names for a system, which was therefore listed
    twice, and one part's reason replaced the other's.
    """
    one_client = {"skipped": {"LeRobot": "its server has one client"}}
    results = {
        "throughput": one_client,
        "without_gain": one_client,
        "evaluation": {"skipped": {"lerobot": "not installed; install it"}},
        "link": {"skipped": {"LeRobot": "no route"}},
    }
    assert list(_skipped(results)) == [
        "round trips over the link of LeRobot (no route)",
        "throughput of LeRobot (its server has one client)",
        "an evaluation with lerobot (not installed)",
    ]


def test_evaluations_are_judged_where_they_were_measured() -> None:
    found = {
        "cores": 2,
        "plan": {"workers": 2},
        "ratios": {"vla-eval": {"median": 1.29}},
        "skipped": {"vlagents": "gone"},
    }
    assert not any("evaluations" in one.what for one in outcomes(RESULTS))
    results = RESULTS | {"evaluation": found}
    [judged] = [line for line in outcomes(results) if "vla-eval, 2 shards" in line.wanted]
    assert (judged.wanted, judged.measured, judged.met) == (
        "≥ 1.3 x vla-eval, 2 shards",
        "1.29",
        False,
    )
    assert "vlagents (gone)" in section(results)
