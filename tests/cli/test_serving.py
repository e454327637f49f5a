"""The output of `vlagents-ray serve`, and its log file."""

from __future__ import annotations

import logging
import re
import stat
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from eval_fakes import wait_for

import vlagents_ray
from vlagents_ray import registry
from vlagents_ray.cli import ray_session
from vlagents_ray.cli.ray_session import quiet_ray
from vlagents_ray.cli.serve import connection_lines
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import POLICIES, names, policy_class
from vlagents_ray.serve.launch import deployment_file
from vlagents_ray.serve.launch.deployment_file import (
    deployment,
    own_settings,
    read_deployment,
    with_gateways_at,
)
from vlagents_ray.serve.ports import EVERYWHERE, LOOPBACK
from vlagents_ray.yaml_text import read_yaml

INFO = (
    "INFO 2026-11-21 17:02:51,406 proxy 127.0.0.1 -- HAProxy starting on node 321f (HTTP port: "
    "8977)."
)
MEANT = ("WARNING 2026-11-21 17:02:48,881 controller 3438 -- HTTPOptions.host='127.0.0.1' won't "
         "accept connections from HAProxy on other nodes; cross-node routing will fail")  # fmt: skip
PROBLEM = "ERROR 2026-11-21 17:02:51,406 controller 3438 -- Deploying app 'x' failed"
PRINTED = "INFO: loading the weights"  # printed by a policy
HAPROXY = "HAProxyManager pid=7"


class Processes:
    """Stand-ins for the processes of this process's Ray, and their output in log files."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def say(self, *lines: str, pid: int = 1) -> None:
        with (self.folder / f"worker-0a-01000000-{pid}.err").open("a") as file:
            file.write("".join(f"{line}\n" for line in lines))


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Processes:
    logs, kept = tmp_path / "logs", tmp_path / "kept"
    logs.mkdir()
    kept.mkdir()
    node = SimpleNamespace(get_logs_dir_path=lambda: str(logs))
    monkeypatch.setattr(ray_session, "node_of_this_process", lambda: node)
    monkeypatch.setattr(ray_session, "started_here", lambda: True)
    monkeypatch.setattr(ray_session, "_FOLLOW_S", 0.01)
    monkeypatch.setattr("tempfile.tempdir", str(kept))
    return Processes(logs)


def test_only_problems_and_what_a_policy_prints_are_shown_and_the_rest_is_in_the_file(
    ray: Processes, capsys: pytest.CaptureFixture[str]
) -> None:
    with quiet_ray("serve-8000") as file:
        ray.say(
            INFO,
            ":job_id:01000000",
            ":actor_name:HAProxyManager",
            INFO,
            MEANT,
            PROBLEM,
            PRINTED,
            pid=7,
        )
        wait_for(lambda: file is not None and MEANT in file.read_text())
        ray.say(INFO)
    assert capsys.readouterr().err.splitlines() == [
        f"({HAPROXY}) {line}" for line in (PROBLEM, PRINTED)
    ]
    assert file is not None
    assert file.name.startswith("serve-8000-")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    expected = [
        f"(ray pid=7) {INFO}",
        f"({HAPROXY}) {INFO}",
        f"({HAPROXY}) {MEANT}",
        f"(ray pid=1) {INFO}",
    ]
    assert file.read_text().splitlines() == expected


def test_after_an_interrupt_what_serves_actors_print_goes_to_the_log_and_what_a_policy_prints_is_shown(
    ray: Processes, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal to the whole process group also ends HAProxy, after which Serve's actors print
    tracebacks of its crash.
    """
    monkeypatch.setattr("vlagents_ray.cli.ray_session.is_interrupted", lambda: True)
    crash = "RuntimeError: Failed to update and reload HAProxy"
    with quiet_ray("serve") as file:
        for pid, actor in enumerate(
            ("HAProxyManager", "ProxyActor", "ServeController", "ServeReplica:noop:Policy")
        ):
            ray.say(f":actor_name:{actor}", crash, pid=pid)
        wait_for(lambda: file is not None and file.read_text().count(crash) == 3)
    assert capsys.readouterr().err.splitlines() == [f"(ServeReplica:noop:Policy pid=3) {crash}"]


def test_a_line_is_read_when_it_is_complete_and_a_rotated_file_from_its_beginning(
    ray: Processes, capsys: pytest.CaptureFixture[str]
) -> None:
    [name, said] = "worker-0a-01000000-1.err", []

    def shown() -> list[str]:
        said.extend(capsys.readouterr().err.splitlines())
        return said

    with quiet_ray("serve"):
        (ray.folder / name).write_text("the first\nthe sec")
        wait_for(lambda: shown() == ["(ray pid=1) the first"])
        ray.say("ond")
        wait_for(lambda: shown()[1:] == ["(ray pid=1) the second"])
        (ray.folder / name).rename(ray.folder / f"{name}.1")
        ray.say("the third")
        wait_for(lambda: shown()[2:] == ["(ray pid=1) the third"])


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
    (
        "ERROR 2026-11-25 07:36:46,517 controller 2516 -- Exception in Replica(id='kfzcaljf', "
        "...), "
        "it "
        "will be stopped."
    ),
    "Traceback (most recent call last):",
    "FileNotFoundError: [Errno 2] No such file or directory: 'nope.npz'",
    "ERROR 2026-11-25 07:36:46,530 controller 2516 -- Failed to update the deployments ['Policy'].",
]


def test_the_traceback_of_a_policy_that_does_not_load_is_in_the_file_until_the_server_serves(
    ray: Processes, capsys: pytest.CaptureFixture[str]
) -> None:
    started = threading.Event()
    said: list[str] = []

    def shown() -> list[str]:
        said.extend(line.partition(") ")[2] for line in capsys.readouterr().err.splitlines())
        return said

    with pytest.raises(ConfigError), quiet_ray("serve", started) as file:  # noqa: PT012
        for count in range(len(LOAD_FAILURE)):  # the reader gets a few lines at a time
            ray.say(LOAD_FAILURE[count])
            ray.say(PRINTED, pid=2)
            wait_for(lambda: len(shown()) > count)  # noqa: B023 - called at once
        ray.say(PROBLEM)
        wait_for(lambda: shown() == [PRINTED] * len(LOAD_FAILURE) + [PROBLEM])
        started.set()
        ray.say(*LOAD_FAILURE)
        wait_for(lambda: shown()[-len(LOAD_FAILURE) :] == LOAD_FAILURE)
        raise ConfigError("the policy did not load")
    assert file is not None
    assert [line.partition(") ")[2] for line in file.read_text().splitlines()] == LOAD_FAILURE
    assert str(file) in capsys.readouterr().err


def test_an_empty_file_does_not_stay(ray: Processes, tmp_path: Path) -> None:
    with pytest.raises(ConfigError), quiet_ray("serve"):
        raise ConfigError("the port is taken")
    with quiet_ray(None) as file:
        assert file is None
    assert list((tmp_path / "kept").iterdir()) == []


def test_a_server_says_its_policy_its_page_and_where_each_kind_of_client_connects() -> None:
    dialects = {"openpi": {"mapping": "openpi-libero"}, "gr00t": {"port": 5556}, "vlagents": {}}
    config = with_gateways_at(
        deployment("noop", config={"action_dim": 7}, dialects=dialects), EVERYWHERE
    )
    said = list(connection_lines(config, {"noop": "https://127.0.0.1:8000"}, EVERYWHERE))
    assert said[0] == "serving noop at https://127.0.0.1:8000"
    assert said[1].startswith("  from other machines: https://")
    assert said[2:] == [
        "  policy: noop (action_dim=7)",
        "  API: https://127.0.0.1:8000/docs",
        "  live page: https://127.0.0.1:8000/live",
        "  gr00t: tcp://0.0.0.0:5556",
        "  openpi: wss://127.0.0.1:8000/, wss://127.0.0.1:8000/openpi",
        "  vlagents: rpyc://0.0.0.0:8080",
    ]


def test_a_server_names_the_pages_of_the_parts_that_are_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def pages(**settings: Any) -> list[str]:
        lines = connection_lines(
            deployment("noop", **settings), {"noop": "http://127.0.0.1:8000"}, LOOPBACK
        )
        return [line for line in lines if "page" in line]

    assert pages() == ["  live page: http://127.0.0.1:8000/live"]
    assert pages(parts={"live": None}) == []
    assert pages(access={"insecure": True}) == [], "the command would show nothing"
    monkeypatch.setattr(registry, "_entry_points", lambda _: {})
    assert pages() == [], "the plug-in is not installed"


def test_the_page_of_a_server_with_keys_is_asked_for_with_one(tmp_path: Path) -> None:
    urls = {"noop": "http://127.0.0.1:8000"}
    page = '  API: curl -H "Authorization: Bearer $VLAGENTS_RAY_API_KEY" http://127.0.0.1:8000/docs'
    assert page in connection_lines(deployment("noop"), urls, "127.0.0.1", tmp_path / "keys.json")
    elsewhere = deployment("noop", access={"keys_file": "/on/the/cluster/keys.json"})
    assert page in connection_lines(elsewhere, urls, "127.0.0.1")
    assert page not in connection_lines(elsewhere, urls, "127.0.0.1", insecure=True)


def _needing_settings() -> list[str]:
    configs = {
        name: getattr(policy_class(name).Config, "model_fields", {}) for name in names("policies")
    }
    return [
        name
        for name, fields in configs.items()
        if any(field.is_required() for field in fields.values())
    ]


@pytest.mark.parametrize("policy", _needing_settings())
def test_a_policy_that_lacks_a_setting_names_a_file_and_a_page_that_have_it(
    policy: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(deployment_file, "_settings_of_checkout", lambda _policy: {})
    with pytest.raises(ConfigError) as raised:
        read_deployment(policy)
    checkout = Path(vlagents_ray.__file__).parents[1]
    [file] = re.findall(r"deployments/\w+\.yaml", str(raised.value))
    [page] = re.findall(r"docs/policies/\w+\.md", str(raised.value))
    assert "is missing; add --set" in str(raised.value)
    assert read_yaml(checkout / file)["applications"][0]["args"]["policy"] == policy
    assert policy in (checkout / page).read_text()


@pytest.mark.parametrize("inside", [True, False], ids=["in the checkout", "elsewhere"])
def test_a_policy_whose_weights_a_checkout_has_is_served_by_its_name(
    inside: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    checkout = Path(vlagents_ray.__file__).parents[1]
    monkeypatch.chdir(checkout if inside else tmp_path)
    of_name = own_settings(read_deployment("reference").applications[0])
    monkeypatch.chdir(checkout)
    of_file = own_settings(read_deployment("deployments/reference.yaml").applications[0])
    assert Path(of_name["checkpoint"]).samefile(of_file["checkpoint"])
    assert of_name == of_file | {"checkpoint": of_name["checkpoint"]}
    changed = read_deployment("reference", {"config": {"execute": 2}})
    assert own_settings(changed.applications[0]) == of_file | {"execute": 2}
    monkeypatch.setitem(POLICIES, "reference", replace(POLICIES["reference"], weights=False))
    with pytest.raises(ConfigError, match="is missing"):
        read_deployment("reference")
