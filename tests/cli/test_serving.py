"""What `vlagents-ray serve` says, and what it keeps in a file."""

from __future__ import annotations

import logging
import stat
import threading
from pathlib import Path
from typing import Any

import pytest
from ray._private import worker

from vlagents_ray.cli.ray_session import quiet_ray
from vlagents_ray.cli.serve import connection_lines
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.launch.deployment_file import deployment, with_gateways_at
from vlagents_ray.serve.ports import EVERYWHERE

INFO = "INFO 2026-11-21 17:02:51,406 proxy 127.0.0.1 -- HAProxy starting on node 321f (HTTP port: 8977)."
MEANT = "WARNING 2026-11-21 17:02:48,881 controller 3438 -- HTTPOptions.host='127.0.0.1' won't accept connections from HAProxy on other nodes; cross-node routing will fail"  # fmt: skip  # noqa: E501
PROBLEM = "ERROR 2026-11-21 17:02:51,406 controller 3438 -- Deploying app 'x' failed"
PRINTED = "INFO: loading the weights"  # by a policy


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The lines of other processes that Ray's own function prints."""
    lines: list[str] = []
    monkeypatch.setattr(worker, "print_to_stdstream", lambda data, **_: lines.extend(data["lines"]))
    return lines


def say(*lines: str, **of: Any) -> None:
    worker.print_to_stdstream({"pid": 1, "is_err": True, "lines": list(lines), **of}, ignore_prefix=False)


def test_only_problems_and_what_a_policy_prints_are_shown_and_the_rest_is_in_the_file(
    printed: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with quiet_ray("serve-8000") as file:
        say(INFO, MEANT, PROBLEM, PRINTED, actor_name="HAProxyManager")
        say(INFO)
    assert printed == [PROBLEM, PRINTED]
    assert file is not None
    assert file.name.startswith("serve-8000-")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert file.read_text().splitlines() == [
        f"(HAProxyManager pid=1) {INFO}",
        f"(HAProxyManager pid=1) {MEANT}",
        f"(ray pid=1) {INFO}",
    ]
    say(INFO)
    assert printed == [PROBLEM, PRINTED, INFO]


def test_the_same_holds_for_what_ray_logs_in_this_process(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    log = logging.getLogger("ray.serve")
    monkeypatch.setattr(log, "propagate", True)
    log.addHandler(caplog.handler)
    try:
        with quiet_ray("serve") as file, caplog.at_level(logging.INFO, "ray.serve"):
            log.info("Started Serve in namespace %r", "serve")
            log.warning("the controller does not answer")
    finally:
        log.removeHandler(caplog.handler)
    assert {record.getMessage() for record in caplog.records} == {"the controller does not answer"}
    assert file is not None
    assert file.read_text() == "Started Serve in namespace 'serve'\n"


LOAD_FAILURE = [
    "ERROR 2026-11-25 07:36:46,517 controller 2516 -- Exception in Replica(id='kfzcaljf', ...), it will be stopped.",
    "Traceback (most recent call last):",
    "FileNotFoundError: [Errno 2] No such file or directory: 'nope.npz'",
    "ERROR 2026-11-25 07:36:46,530 controller 2516 -- Failed to update the deployments ['Policy'].",
]


def test_the_traceback_of_a_policy_that_does_not_load_is_in_the_file_until_the_server_serves(
    printed: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    started = threading.Event()
    with pytest.raises(ConfigError), quiet_ray("serve", started) as file:  # noqa: PT012
        for line in LOAD_FAILURE:  # Ray hands on a few lines at a time
            say(line)
            say(PRINTED, pid=2)
        say(PROBLEM)
        assert printed == [PRINTED] * len(LOAD_FAILURE) + [PROBLEM]
        started.set()
        say(*LOAD_FAILURE)
        assert printed[-len(LOAD_FAILURE) :] == LOAD_FAILURE
        raise ConfigError("the policy did not load")
    assert file is not None
    assert [line.partition(") ")[2] for line in file.read_text().splitlines()] == LOAD_FAILURE
    assert str(file) in capsys.readouterr().err


def test_an_empty_file_does_not_stay(printed: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(ConfigError), quiet_ray("serve"):
        raise ConfigError("the port is taken")
    assert list(tmp_path.iterdir()) == []


def test_without_a_name_there_is_no_file(printed: list[str]) -> None:
    with quiet_ray(None) as file:
        say(INFO, PROBLEM)
    assert (file, printed) == (None, [PROBLEM])


def test_a_server_says_its_policy_its_page_and_where_each_kind_of_client_connects() -> None:
    dialects = {"openpi": {"mapping": "openpi-libero"}, "gr00t": {"port": 5556}, "vlagents": {}}
    config = with_gateways_at(deployment("noop", config={"action_dim": 7}, dialects=dialects), EVERYWHERE)
    said = list(connection_lines(config, {"noop": "https://127.0.0.1:8000"}, EVERYWHERE))
    assert said[0] == "serving noop at https://127.0.0.1:8000"
    assert said[1].startswith("  from other machines: https://")
    assert said[2:] == [
        "  policy: noop (action_dim=7)",
        "  how to talk to it: https://127.0.0.1:8000/docs",
        "  what it does now: https://127.0.0.1:8000/live",
        "  openpi: wss://127.0.0.1:8000/, wss://127.0.0.1:8000/openpi",
        "  gr00t: tcp://0.0.0.0:5556",
        "  vlagents: rpyc://0.0.0.0:8080",
    ]


def test_the_page_of_a_server_with_keys_is_asked_for_with_one(tmp_path: Path) -> None:
    urls = {"noop": "http://127.0.0.1:8000"}
    page = '  how to talk to it: curl -H "Authorization: Bearer $VLAGENTS_RAY_API_KEY" http://127.0.0.1:8000/docs'
    assert page in connection_lines(deployment("noop"), urls, "127.0.0.1", tmp_path / "keys.json")
    elsewhere = deployment("noop", access={"keys_file": "/on/the/cluster/keys.json"})
    assert page in connection_lines(elsewhere, urls, "127.0.0.1")
    assert page not in connection_lines(elsewhere, urls, "127.0.0.1", insecure=True)
