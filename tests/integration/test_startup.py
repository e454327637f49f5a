"""Servers that start, load, fail and stop."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest
from eval_fakes import wait_for
from ray_processes import ray_folder
from rpyc_client import Client, call

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.envs import make_env
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray.serve.ports import free_port

COMMAND = [str(Path(sys.executable).parent / "vlagents-ray")]
ROOT = Path(__file__).parent.parent.parent
INTERRUPTED = 130  # exit status before the server serves; later it is 0


def health(url: str) -> int | None:
    try:
        with urllib.request.urlopen(f"{url}/healthz", timeout=5) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        error.close()
        return error.code
    except OSError:
        return None


@contextmanager
def command(*words: str, start_new_session: bool = False) -> Iterator[subprocess.Popen[str]]:
    """Run `vlagents-ray …` like a user; each process that it started must have ended afterwards."""
    process = subprocess.Popen(
        [*COMMAND, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
        start_new_session=start_new_session,
    )
    family: set[psutil.Process] = set()
    try:
        yield process
    finally:
        if process.poll() is None:
            family = set(psutil.Process(process.pid).children(recursive=True))
            process.send_signal(signal.SIGTERM)
        said, _ = process.communicate(timeout=180)
        if family:
            assert process.returncode in (0, INTERRUPTED), (
                f"ended with {process.returncode}:\n{said[-4000:]}"
            )
        _, alive = psutil.wait_procs(list(family), timeout=30)
        names = [p.name() for p in alive]
        for p in alive:
            p.kill()
        assert not names, f"processes still running: {names}"


def test_the_port_is_closed_while_the_policy_loads_and_clients_wait_for_it(tmp_path: Path) -> None:
    """openpi's client, for example, waits only while its connection is refused."""
    gate, port = tmp_path / "gate", free_port()
    url = f"http://127.0.0.1:{port}"
    answers: list[Any] = []

    def robot() -> None:
        with RemoteAgent(url) as agent:
            answers.append(agent.reset(Obs(), "x"))

    def watch() -> None:
        wait_for(Path(f"{gate}.loading").exists)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port), timeout=5)
        answers.append("refused")
        thread.start()
        gate.touch()

    thread, watcher = threading.Thread(target=robot), threading.Thread(target=watch)
    watcher.start()
    with running_server(deployment("served_agents:Gated", config={"gate": str(gate)}), port=port):
        watcher.join(120)
        thread.join(120)
        first, info = answers
        assert first == "refused"
        # The digest of the file that a setting names.
        assert info["weights"].startswith("sampled-sha256:")
        assert health(url) == 200


@dataclass(frozen=True)
class Started:
    """A server started by command, whose actions have `action_dim` numbers. `robots` is its port
    for vlagents' clients, if any.
    """

    process: subprocess.Popen[str]
    url: str
    action_dim: int
    robots: int | None = None


@pytest.fixture(scope="module")
def two_servers() -> Iterator[list[Started]]:
    """Yield two running servers on this machine."""
    ports, robots = [free_port(), free_port()], free_port()
    options = [
        ["--set", "action_dim=3", "--vlagents-port", str(robots)],
        ["--set", "action_dim=5", "--serve-set", "batch.max_size=2"],
    ]
    with contextlib.ExitStack() as stack:
        # On a busy machine Ray may rightly warn of a slow replica; see test_start_and_stop.py.
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        patch.setenv("RAY_SERVE_QUEUE_LENGTH_RESPONSE_DEADLINE_S", "60")
        processes = [
            stack.enter_context(
                command("serve", "noop", "--port", str(port), *words, start_new_session=True)
            )
            for port, words in zip(ports, options, strict=True)
        ]
        for process in processes:
            assert process.stdout is not None
            assert "Ctrl-C stops\n" in iter(process.stdout.readline, "")
        urls = [f"http://127.0.0.1:{port}" for port in ports]
        yield [
            Started(processes[0], urls[0], action_dim=3, robots=robots),
            Started(processes[1], urls[1], action_dim=5),
        ]


def test_two_servers_on_one_machine_do_not_meet(two_servers: list[Started]) -> None:
    for server in two_servers:
        with RemoteAgent(server.url, connect_timeout_s=120) as agent:
            assert health(server.url) == 200
            agent.reset(Obs(), "x")
            for _ in range(20):
                assert agent.act(Obs()).action.shape == (server.action_dim,)
    robots = two_servers[0].robots
    assert robots is not None
    wait_for(lambda: _name_at(robots) == "noop")


@pytest.mark.parametrize(
    ("number", "whole"),
    [(0, signal.SIGTERM), (1, signal.SIGINT)],
    ids=["service", "terminal"],
)
def test_a_signal_to_every_process_of_a_server_ends_it_in_seconds_and_in_silence(
    number: int, whole: signal.Signals, two_servers: list[Started]
) -> None:
    """systemd sends SIGTERM to all processes of a service. Then Ray's head may end before Serve.

    tests/cli/test_start_and_stop.py sends the signal only to the command.
    """
    server, other = two_servers[number], two_servers[1 - number]
    process = server.process
    family = psutil.Process(process.pid).children(recursive=True)
    for one in [psutil.Process(process.pid), *family]:
        # Some processes end on their own, or together with earlier ones.
        with suppress(ProcessLookupError, psutil.NoSuchProcess):
            if whole == signal.SIGTERM or os.getpgid(one.pid) == process.pid:
                one.send_signal(whole)
    begun = time.monotonic()
    assert process.wait(60) == 0
    assert time.monotonic() - begun < 15  # 3 s on an idle machine; an earlier version took 36 s
    assert not psutil.wait_procs(family, timeout=10)[1]
    assert process.stdout is not None
    assert process.stdout.read() == ""
    if server.robots is not None:
        with pytest.raises(ConnectionRefusedError):
            Client(server.robots)
    if other.process.poll() is None:
        assert health(other.url) == 200


def test_a_taken_port_is_said_at_once() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        result = subprocess.run(
            [*COMMAND, "serve", "noop", "--port", str(taken.getsockname()[1])],
            capture_output=True, text=True, timeout=180, check=False,
        )  # fmt: skip
    assert result.returncode == 2
    assert "choose another --port" in result.stderr


@pytest.mark.integration
def test_serve_deploy_takes_the_same_file(tmp_path: Path) -> None:
    """Ray's own tools deploy the file on a cluster that they started."""
    serve_port, dashboard, gcs, robots = free_port(), free_port(), free_port(), free_port()
    text = (ROOT / "deployments" / "scripted.yaml").read_text()
    file = tmp_path / "scripted.yaml"
    text = text.replace("args:\n", f"args:\n      dialects: {{vlagents: {{port: {robots}}}}}\n")
    file.write_text(text.replace("port: 8000", f"port: {serve_port}"))
    assert "dialects" in file.read_text()
    assert str(serve_port) in file.read_text()
    bin_dir = Path(sys.executable).parent
    environment = os.environ | {
        "RAY_AUTH_MODE": "disabled",
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    failing = tmp_path / "failing.yaml"
    failing.write_text(
        f"http_options: {{port: {serve_port}}}\napplications:\n"
        "  - {name: broken, route_prefix: /broken, import_path: 'vlagents_ray.serve.app:build',"
        " args: {policy: 'served_agents:Broken'}}\n"
        "  - {name: large, route_prefix: /large, import_path: 'vlagents_ray.serve.app:build',"
        " args: {policy: noop, resources: {num_gpus: 100}}}\n"
        "  - {name: nowhere, route_prefix: /nowhere, import_path: 'vlagents_ray.serve.app:build',"
        " args: {policy: noop, environment: {python: /nowhere/bin/python}}}\n"
    )

    def ray(*words: str, check: bool = True) -> bool:
        done = subprocess.run(words, check=check, timeout=120, env=environment, capture_output=True)
        return done.returncode == 0

    with ray_folder() as home:
        ray(
            str(bin_dir / "ray"),
            "start",
            "--head",
            f"--port={gcs}",
            f"--dashboard-port={dashboard}",
            "--num-cpus=2",
            f"--temp-dir={home}",
            "--min-worker-port=0",
            "--max-worker-port=0",
        )
        deploy = (
            str(bin_dir / "serve"),
            "deploy",
            "-a",
            f"http://127.0.0.1:{dashboard}",
            str(file),
        )
        # The dashboard starts some time after `ray start` has ended. Each attempt of `serve deploy`
        # takes seconds.
        wait_for(
            lambda: _answer(f"http://127.0.0.1:{dashboard}/api/serve/applications/")[0] != 0, 120
        )
        wait_for(lambda: ray(*deploy, check=False), 300)
        url = f"http://127.0.0.1:{serve_port}"
        wait_for(lambda: health(url) == 200)
        with urllib.request.urlopen(f"{url}/v1/metadata", timeout=60) as answer:
            assert json.load(answer)["policy"] == "scripted"
        with RemoteAgent(url) as agent, make_env("tabletop") as env:
            obs, _ = env.reset(seed=0)
            agent.reset(obs, env.instruction, env="tabletop")
            env.step(agent.act(obs))
        wait_for(lambda: _name_at(robots) == "scripted")

        ray(*deploy[:-1], str(failing))
        seen: list[str] = []
        wait_for(
            lambda: seen.append(_status(dashboard, "broken")[0]) or seen[-1] == "DEPLOY_FAILED", 120
        )
        assert "RUNNING" not in seen
        assert (
            "the policy did not load: FileNotFoundError: no checkpoint here"
            in _status(dashboard, "broken")[1]
        )
        assert _status(dashboard, "large")[0] == "DEPLOYING"
        wait_for(lambda: _status(dashboard, "nowhere")[0] == "DEPLOY_FAILED", 120)
        first, said = _status(dashboard, "nowhere")[1].strip().splitlines()
        assert first == "Deploying app 'nowhere' failed with exception:"
        assert said.startswith(
            "ConfigError: environment.python: expected an interpreter, got '/nowhere/bin/python'"
        )
        for app in ("broken", "large"):
            for path in ("healthz", "v1/metadata"):
                wait_for(lambda place=f"{url}/{app}/{path}": _answer(place)[0] == 503)  # type: ignore[misc]
                _, headers = _answer(f"{url}/{app}/{path}")
                assert headers["retry-after"] or app == "broken"


def _status(dashboard: int, app: str) -> tuple[str, str]:
    """Return the status of an application in `serve status`, and its reason."""
    with urllib.request.urlopen(
        f"http://127.0.0.1:{dashboard}/api/serve/applications/", timeout=30
    ) as answer:
        found = json.load(answer)["applications"].get(app)
    if found is None:
        return "", ""
    return found["status"], " ".join(
        [found["message"], *(d["message"] for d in found["deployments"].values())]
    )


def _answer(url: str) -> tuple[int, Mapping[str, str]]:
    try:
        with urllib.request.urlopen(url, timeout=10) as answer:
            return answer.status, answer.headers
    except urllib.error.HTTPError as error:
        error.close()
        return error.code, error.headers
    except OSError:
        return 0, {}


def _name_at(port: int) -> str | None:
    """Return the name of the policy at the vlagents endpoint on that port."""
    try:
        with Client(port) as client:
            client.send(call("name"))
            return str(client.receive()[2][1])
    except (OSError, EOFError):
        return None
