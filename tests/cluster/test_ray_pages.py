"""docs/cluster/index.md runs as written on three hosts; and the files in cluster/ray work."""

from __future__ import annotations

import copy
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml
from eval_fakes import wait_for
from ray.autoscaler._private.util import prepare_config, validate_config
from readme_blocks import ENV, PYTHON, Block, blocks
from simulated_hosts import Host, HostFailed, hosts

from vlagents_ray.evaluate.results.reader import Results
from vlagents_ray.serve.launch.haproxy import ROBOTS, haproxy_binary, ingress_environment

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "cluster" / "ray").glob("*.yaml"))
PAGE = blocks((ROOT / "docs" / "cluster" / "index.md").read_text())
SCRIPT = ROOT / "cluster" / "ray" / "environment.sh"
TIMEOUT_S = 240
HAPROXY = "RAY_SERVE_HAPROXY_BINARY_PATH"


def said_of(where: str) -> list[Block]:
    """Return the page's blocks that are marked to run at that place."""
    return [block for block in PAGE if (block.not_run or "").startswith(where)]


class Machines:
    """The page's machines as simulated hosts, each with its own home folder and the same
    checkout.
    """

    def __init__(self, first: Host, second: Host, robot: Host, checkout: Path) -> None:
        self.first, self.second, self.robot, self.checkout = first, second, robot, checkout
        for host in (first, second, robot):
            home = host.folder / "home"
            home.mkdir()
            host.environment |= {
                "HOME": str(home),
                "PATH": ENV["PATH"],
                "RAY_USAGE_STATS_ENABLED": "0",
            }

    def home(self, host: Host) -> Path:
        return Path(host.environment["HOME"])

    def command(self, block: Block) -> list[str]:
        source = block.source
        for number, host in enumerate((self.first, self.second), 1):
            source = source.replace(f"10.0.0.{number}", host.address)
        program = [sys.executable, "-c"] if block.language in PYTHON else ["bash", "-eu", "-c"]
        return ["env", f"--chdir={self.checkout}", *program, source]

    def run(self, host: Host, block: Block) -> str:
        return host.run(self.command(block), TIMEOUT_S)

    @contextmanager
    def serving(self, block: Block, log: Path) -> Iterator[None]:
        """Run the block on the first machine during the context, from the time when it serves; end
        it with Ctrl-C.
        """
        number = self.checkout / "server.pid"
        command = self.command(block)
        command[-1] = f"echo $$ >{number}\n" + command[-1].replace(
            "vlagents-ray serve", "exec vlagents-ray serve"
        )
        with log.open("w") as output:
            server = self.first.start(command, stdout=output, stderr=subprocess.STDOUT)

        def serves() -> bool:
            assert server.poll() is None, log.read_text()
            return "serving scripted at" in log.read_text()

        try:
            wait_for(serves)
            yield
        finally:
            if server.poll() is None:
                self.first.run(["kill", f"-{signal.SIGINT.value}", number.read_text().strip()])
            try:
                assert server.wait(180) == 0, log.read_text()
            except subprocess.TimeoutExpired:
                server.kill()
                server.wait()
                pytest.fail(f"serve did not end: {log.read_text()}")


@pytest.mark.hosts
@pytest.mark.slow
def test_the_page_makes_a_cluster_that_serves_a_robot_and_evaluates(tmp_path: Path) -> None:
    start, status, keys, evaluation = said_of("on the first machine")
    [join], [serve], [play], [stop] = map(
        said_of, ("on the second machine", "serves on the first", "on the robot", "at the end")
    )
    shutil.copytree(ROOT / "cluster", tmp_path / "cluster")
    with hosts(3) as made:
        machines = Machines(*made, tmp_path)
        first, second, robot = made
        machines.run(first, start)
        with pytest.raises(HostFailed, match="no authentication token was found"):
            machines.run(second, join)
        token = machines.home(first) / ".ray" / "auth_token"
        (machines.home(second) / ".ray").mkdir()
        shutil.copy(token, machines.home(second) / ".ray")
        machines.run(second, join)
        # Ray prints the status every few seconds.
        wait_for(lambda: machines.run(first, status).count("node_") == 2)

        machines.run(first, keys)
        key = (tmp_path / "arm-1.key").read_text().split()[0]
        with machines.serving(serve, tmp_path / "serve.log"):
            robot.environment["VLAGENTS_RAY_API_KEY"] = "vlr_wrong"
            with pytest.raises(HostFailed, match="Unauthorized"):
                machines.run(robot, play)
            robot.environment["VLAGENTS_RAY_API_KEY"] = key
            assert machines.run(robot, play).split() == ["websocket"]
            machines.run(first, evaluation)
        [case] = Results.load(tmp_path / "runs" / "lab").cases
        assert [episode.result.status for episode in case.episodes] == ["done"] * 8
        for host in (second, first):
            machines.run(host, stop)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_file_for_ray_up_is_as_ray_wants_it(file: Path) -> None:
    config = yaml.safe_load(file.read_text())
    prepared = prepare_config(copy.deepcopy(config))
    validate_config(prepared)
    assert prepared["head_node_type"] in prepared["available_node_types"]
    for path in config["file_mounts"].values():
        assert path.startswith("~") or (ROOT / path).is_dir()
    starts = [*prepared["head_start_ray_commands"], *prepared["worker_start_ray_commands"]]
    assert all("cluster/environment.sh" in command for command in starts if "ray start" in command)


def test_a_misspelt_key_in_one_is_found() -> None:
    config = prepare_config(yaml.safe_load(FILES[0].read_text()))
    with pytest.raises(Exception, match="mispelt"):
        validate_config(config | {"mispelt": 1})


def test_the_settings_for_ray_start_are_those_of_a_server_of_our_own() -> None:
    variables = ["RAY_AUTH_MODE", *ROBOTS]
    show = f". {SCRIPT}; {sys.executable} -c 'import os, json; print(json.dumps(dict(os.environ)))'"
    done = subprocess.run(
        ["sh", "-eu", "-c", show], capture_output=True, text=True, check=True, env={}
    )
    said = yaml.safe_load(done.stdout)
    assert {name: said[name] for name in variables} == {"RAY_AUTH_MODE": "token", **ROBOTS}


def haproxy_files(home: Path, times: int = 1) -> dict[str, Path]:
    """Return the paths of HAProxy's files that the script sets, with /tmp replaced by `home`, after
    the script was sourced `times` times.
    """
    script = home / "environment.sh"
    script.write_text(SCRIPT.read_text().replace("/tmp/", f"{home}/"))
    environment = {"PATH": ENV["PATH"], "PYTHONPATH": str(ROOT)}
    read = f". {script}; " * times + "env"
    done = subprocess.run(
        ["sh", "-euc", read], capture_output=True, text=True, check=True, env=environment
    )
    said = dict(
        line.split("=", 1)
        for line in done.stdout.splitlines()
        if line.startswith("RAY_SERVE_HAPROXY_")
    )
    return {name: Path(value) for name, value in said.items() if value.startswith("/")}


@pytest.mark.slow
def test_no_other_user_reaches_the_socket_that_commands_haproxy(tmp_path: Path) -> None:
    """HAProxy's files are neither in a folder that another user has created before, nor reachable
    through a link.
    """
    own = ingress_environment(tmp_path, "/bin/true")
    wanted = {name for name, value in own.items() if value.startswith(str(tmp_path))}
    (tmp_path / "no-replica.http").unlink()
    files = haproxy_files(tmp_path, times=2)  # as on the page
    assert set(files) == wanted
    # HAProxy's binary is called, not the launcher itself
    assert str(haproxy_binary()) in files[HAPROXY].read_text()
    folder = tmp_path / f"vlr-haproxy-{os.getuid()}"
    assert {path if path == folder else path.parent for path in files.values()} == {folder}
    assert folder.stat().st_mode & 0o777 == 0o700
    assert haproxy_files(tmp_path) == files
    longest = (
        f"/tmp/{folder.name}/{'0' * 56}/{files['RAY_SERVE_HAPROXY_SOCKET_PATH'].name}.1234567.tmp"
    )
    assert len(longest) <= 107

    folder.chmod(0o755)
    assert_elsewhere(tmp_path, folder)
    shutil.rmtree(folder)
    (tmp_path / "other").mkdir(mode=0o700)
    folder.symlink_to(tmp_path / "other")
    assert_elsewhere(tmp_path, folder)


def assert_elsewhere(home: Path, folder: Path) -> None:
    files = haproxy_files(home)
    new = files["RAY_SERVE_HAPROXY_SOCKET_PATH"].parent
    assert new.parent == folder.parent
    assert new != folder
    assert new.stat().st_mode & 0o777 == 0o700
