"""Joining a Ray cluster that runs already."""

from __future__ import annotations

import os
import re
import socket
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
import ray
from ray._private.ray_constants import DEFAULT_DASHBOARD_AGENT_LISTEN_PORT

from vlagents_ray import ConfigError
from vlagents_ray.joining import joined

# A start-up file of Python's that holds one of Ray's helpers back for longer than Ray's daemon waits for it.
SLOW = """
import os, time
from pathlib import Path
asked = Path({asked!r})
if "dashboard/agent.py" in Path("/proc/self/cmdline").read_text():
    with asked.open("a") as file:
        file.write("x")
    if asked.stat().st_size <= {slow}:
        time.sleep(60)
"""


@pytest.mark.parametrize(
    "error", [ConnectionError("nobody there"), ray.exceptions.AuthenticationError("another token")], ids=repr
)
def test_a_cluster_that_cannot_be_joined_is_a_wrong_setting(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_options: object) -> None:
        raise error

    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(ConfigError, match=re.escape(f"Ray cluster at 'auto': {error}")), joined("auto"):
        pytest.fail("joined it")


def test_the_cluster_that_the_environment_names_is_named_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_options: object) -> None:
        raise ConnectionError("nobody there")

    monkeypatch.setattr(ray, "init", refuse)
    monkeypatch.setenv("RAY_ADDRESS", "198.18.0.9:6379")
    with pytest.raises(ConfigError, match=r"Ray cluster at '198\.18\.0\.9:6379'"), joined():
        pytest.fail("joined it")


def slow_helpers(folder: Path, monkeypatch: pytest.MonkeyPatch, slow: int) -> Path:
    """The first `slow` of them; returns a file of as many bytes as were started."""
    asked = folder / "asked"
    (folder / "sitecustomize.py").write_text(SLOW.format(asked=str(asked), slow=slow))
    monkeypatch.setenv("PYTHONPATH", f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    return asked


def test_a_machine_that_is_slow_to_start_ray_gets_another_attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked = slow_helpers(tmp_path, monkeypatch, 1)
    before = set(psutil.Process().children(recursive=True))
    with joined("local", num_cpus=1, include_dashboard=False):
        assert ray.get(ray.put(5)) == 5
        assert len(ray.nodes()) == 1
    assert asked.read_text() == "xx"
    assert "attempt 2 of 3" in caplog.text
    assert re.search("Ray's daemon: .*Timed out waiting for file .*agent", caplog.text)
    _, left = psutil.wait_procs(set(psutil.Process().children(recursive=True)) - before, 30)
    assert not left


@pytest.mark.parametrize(
    ("error", "said", "attempts"),
    [
        (Exception("it timed out"), r"did not start .* in 3 attempts: it timed out\. .* Logs: /", 3),
        (ValueError("no"), "^no$", 1),
    ],
    ids=["time", "option"],
)
def test_a_ray_that_does_not_start_leaves_nothing(
    error: Exception, said: str, attempts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once its processes are there; what is wrong with an option is not tried again."""
    failures: list[object] = []

    def fail(*_: object) -> None:
        failures.append(None)
        raise error

    monkeypatch.setattr("ray._private.services.get_node", fail)
    before = set(psutil.Process().children(recursive=True))
    with pytest.raises(ValueError, match=said), joined("local", num_cpus=1, include_dashboard=False):
        pytest.fail("started")
    assert len(failures) == attempts
    assert not ray.is_initialized()
    _, left = psutil.wait_procs(set(psutil.Process().children(recursive=True)) - before, 30)
    assert not left


def test_a_folder_that_ray_may_not_write_is_said_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """/tmp/ray of another user's: there are no logs then, and no other attempt would do better."""
    tries: list[object] = []

    def refuse(*_: object) -> None:
        tries.append(None)
        raise PermissionError("/tmp/ray")

    monkeypatch.setattr("ray._private.node.Node._init_temp", refuse)
    with pytest.raises(PermissionError, match="/tmp/ray"), joined("local", num_cpus=1, include_dashboard=False):
        pytest.fail("started")
    assert len(tries) == 1
    assert not ray.is_initialized()


def test_a_helper_of_ray_leaves_the_port_alone_that_every_ray_has_for_it() -> None:
    """The second Ray on a machine would try for seconds, and go without."""
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with suppress(OSError):  # another Ray's: as well
            taken.bind(("127.0.0.1", DEFAULT_DASHBOARD_AGENT_LISTEN_PORT))
            taken.listen()
        with joined("local", num_cpus=1, include_dashboard=False):
            (file,) = Path(ray._private.worker.global_worker.node.get_session_dir_path()).glob(
                "dashboard_agent_listen_*"
            )
            assert int(file.read_text()) > 0
