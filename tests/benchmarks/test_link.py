"""The parts of the emulated link, and the message for a user without the right to create it."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from eval_fakes import wait_for

from benchmarks.link import enter, measure_link, refused, shaping
from vlagents_ray.errors import ConfigError


def test_a_link_is_shaped_to_its_rate_and_delayed_if_asked_to() -> None:
    assert shaping("1gbit", None) == [
        ["root", "tbf", "rate", "1gbit", "burst", "64kb", "latency", "50ms"]
    ]
    first, second = shaping("100mbit", "2ms")
    assert first[3:6] == ["netem", "delay", "2ms"]
    assert second[:5] == ["parent", "1:1", "tbf", "rate", "100mbit"]


def test_who_may_not_make_namespaces_is_told_how_to() -> None:
    text = refused(["Operation not permitted", "Permission denied"])
    assert "Operation not permitted; Permission denied" in text
    assert "run it as root" in text
    assert "unprivileged_userns_clone=1" in text


def test_missing_tools_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(
        ConfigError, match="ip, tc, unshare, nsenter not found; install iproute2 and util-linux"
    ):
        enter()


@pytest.mark.slow
def test_both_namespaces_end_with_a_bench_that_was_killed() -> None:
    """A process keeps the client's namespace alive, and the bench itself the server's."""
    try:
        command = enter()
    except ConfigError as error:
        assert "run it as root" in str(error)  # noqa: PT017 - a machine without namespaces has only this to show
        return
    code = (
        "import time\nfrom benchmarks.link import EmulatedLink\n"
        "with EmulatedLink('1gbit', None) as link:\n    print(link.prefix[1], flush=True)\n    "
        "time.sleep(60)"
    )
    with subprocess.Popen(
        [*command, sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as bench:
        assert bench.stdout is not None
        namespace = Path(bench.stdout.readline().strip().removeprefix("--net="))
        assert namespace.exists()
        bench.send_signal(signal.SIGKILL)
    wait_for(lambda: not namespace.exists())


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.server
@pytest.mark.alone
def test_round_trips_over_a_link_or_the_reason_why_not(tmp_path: Path) -> None:
    """The link is so slow that the pixels of a call (300 kB) take visibly longer than their
    JPEG.
    """
    try:
        enter()
    except ConfigError as error:
        assert "run it as root" in str(error)  # noqa: PT017 - a machine without namespaces has only this to show
        return
    told: list[str] = []
    for _ in range(3):  # a busy machine may not fill the link
        found = measure_link(
            25,
            rate="100mbit",
            peers=["openpi"],
            peers_python=tmp_path / "none",
            progress=told.append,
        )
        if found["link"]["measured_mbit_per_s"] > 50:
            break
    assert 50 < found["link"]["measured_mbit_per_s"] <= 100
    medians = {way["way"]: way["median_ms"] for way in found["ways"]}
    assert medians["websocket, raw"] > 301_056 * 8 / 100e6 * 1e3  # the time that its bytes take
    assert medians["websocket, jpeg"] < medians["websocket, raw"]
    assert "benchmarks.peers" in found["skipped"]["openpi"]
    assert told[0].startswith("the link carries")
    left = subprocess.run(
        ["ip", "-brief", "link"], capture_output=True, text=True, check=True
    ).stdout
    assert "vlagents" not in left
