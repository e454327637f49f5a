"""Joining a running Ray cluster, and starting a separate one."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import ray
from eval_fakes import wait_for
from in_process_evaluation import flat_config
from ray_processes import leaked, processes, words
from ray_processes import ray_folder as ray_folder_of_test

from vlagents_ray import ConfigError
from vlagents_ray.client.credentials import KEY_VARIABLE
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.workers.cluster import ray_cluster
from vlagents_ray.ray_tools import session as joining
from vlagents_ray.ray_tools.session import joined, ray_folder

# A start-up file of Python that delays one of Ray's helper processes for longer than Ray's daemon
# waits for it.
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
    "error",
    [ConnectionError("nobody there"), ray.exceptions.AuthenticationError("another token")],
    ids=repr,
)
def test_a_cluster_that_cannot_be_joined_is_a_wrong_setting(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_options: object) -> None:
        raise error

    monkeypatch.setattr(ray, "init", refuse)
    monkeypatch.setattr(joining, "local_servers", list)
    monkeypatch.setenv("RAY_ADDRESS", "198.18.0.9:6379")
    for asked, named in (("auto", "auto"), (None, "198.18.0.9:6379")):
        cause = re.escape(f"Ray cluster at '{named}': {error}")
        with pytest.raises(ConfigError, match=cause), joined(*([asked] if asked else [])):
            pytest.fail("joined it")


@pytest.mark.parametrize(
    ("here", "own"), [("127.0.0.1:1", True), ("127.0.0.1:2", False), (None, False)]
)
def test_a_cluster_that_was_lost_is_not_taken_for_the_one_that_this_process_joined_later(
    monkeypatch: pytest.MonkeyPatch, here: str | None, own: bool
) -> None:
    monkeypatch.setattr(joining, "_started", [SimpleNamespace(gcs_address="127.0.0.1:1")])
    monkeypatch.setattr(
        joining.private, "node_of_this_process", lambda: here and SimpleNamespace(gcs_address=here)
    )
    assert joining.started_here() is own


@pytest.mark.parametrize(
    ("address", "started", "wanted"),
    [
        ("http://127.0.0.1:8000", None, "http://127.0.0.1:8000"),
        ("http://127.0.0.1:8000", "198.18.0.9:6379", "http://127.0.0.1:8000"),
        ("auto", None, None),
        # For a cluster of `ray start`, which prints the address.
        ("auto", "198.18.0.9:6379", "Ray's"),
    ],
)
def test_the_url_of_a_server_stands_for_its_ray_and_so_does_auto_where_no_other_was_started(
    address: str, started: str | None, wanted: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    joins: list[str | None] = []
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setattr(joining, "local_servers", lambda: ["a server"])
    monkeypatch.setattr("ray._private.utils.read_ray_address", lambda: started)
    monkeypatch.setattr(joining, "join", lambda server, **_: joins.append(server))
    monkeypatch.setattr(ray, "init", lambda **_: joins.append("Ray's"))
    with joined(address):
        assert joins == [wanted]


def slow_helpers(folder: Path, monkeypatch: pytest.MonkeyPatch, slow: int) -> Path:
    """Delay the first `slow` helpers; return a file with one byte for each started helper."""
    asked = folder / "asked"
    (folder / "sitecustomize.py").write_text(SLOW.format(asked=str(asked), slow=slow))
    monkeypatch.setenv("PYTHONPATH", f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    return asked


@pytest.mark.ray
def test_a_machine_that_is_slow_to_start_ray_gets_another_attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked = slow_helpers(tmp_path, monkeypatch, 1)
    before = set(psutil.Process().children(recursive=True))
    with joined("local", num_cpus=1):
        assert ray.get(ray.put(5)) == 5
        [node] = ray.nodes()
        assert joining.cluster_id() == node["NodeID"]
    # A third attempt is possible on a machine that is slow by itself.
    assert asked.read_text() in ("xx", "xxx")
    assert "attempt 2 of 3" in caplog.text
    assert re.search("Ray's daemon: .*Timed out waiting for file .*agent", caplog.text)
    _, left = psutil.wait_procs(set(psutil.Process().children(recursive=True)) - before, 30)
    assert not left


@pytest.mark.parametrize(
    ("error", "said", "attempts"),
    [
        (
            Exception("it timed out"),
            r"did not start .* in 3 attempts: it timed out\. .* Logs: /",
            3,
        ),
        (ValueError("no"), "^no$", 1),
    ],
    ids=["time", "option"],
)
@pytest.mark.ray
def test_a_ray_that_does_not_start_leaves_nothing(
    error: Exception, said: str, attempts: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The failure occurs after Ray's processes have started; a wrong option causes no further
    attempt.
    """
    failures: list[object] = []

    def fail(*_: object) -> None:
        failures.append(None)
        raise error

    monkeypatch.setattr("ray._private.services.get_node", fail)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))  # the logs remain there
    before = set(psutil.Process().children(recursive=True))
    with pytest.raises(ValueError, match=said), joined("local", num_cpus=1):
        pytest.fail("started")
    # On a slow machine, an attempt may end before it asks for its node.
    assert 1 <= len(failures) <= attempts
    assert not ray.is_initialized()
    _, left = psutil.wait_procs(set(psutil.Process().children(recursive=True)) - before, 30)
    assert not left


def test_a_folder_that_ray_may_not_write_is_said_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """/tmp/ray may belong to another user. Then there are no logs, and another attempt would also
    fail.
    """
    tries: list[object] = []

    def refuse(*_: object) -> None:
        tries.append(None)
        raise PermissionError("/tmp/ray")

    monkeypatch.setattr("ray._private.node.Node._init_temp", refuse)
    with pytest.raises(PermissionError, match="/tmp/ray"), joined("local", num_cpus=1):
        pytest.fail("started")
    assert len(tries) == 1
    assert not ray.is_initialized()


def programs() -> set[str]:
    """Return the command lines of this process's children, without folders."""
    return {Path(word).name for one in psutil.Process().children() for word in words(one)}


def session() -> Path:
    """Return the session folder of this process's Ray."""
    return Path(ray._private.worker.global_worker.node.get_session_dir_path())


@pytest.mark.ray
def test_a_ray_of_ones_own_is_in_a_folder_that_no_other_user_enters_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every user may write to Ray's default folders, so their sockets and logs could belong to
    others. The separate Ray has no autoscaler, no log monitor and no dashboard.
    """
    with ray_folder_of_test() as place:
        place.chmod(0o755)
        monkeypatch.setenv("RAY_TMPDIR", str(place / "new"))
        key = f"vlr_{os.urandom(8).hex()}"
        monkeypatch.setenv(KEY_VARIABLE, key)
        with ray_cluster(resolve(flat_config(envs=["tabletop/lift"], out=tmp_path))):
            (sockets,) = session().glob("sockets")
            assert (sockets / "raylet").is_socket()
            closed = [one for one in sockets.parents if one.stat().st_mode & 0o077 == 0]
            assert closed == [*(place / "new").iterdir()]
            assert leaked(key, [place]) == []
            assert {"gcs_server", "raylet"} <= programs()
            wait_for(lambda: not {"monitor.py", "log_monitor.py", "dashboard.py"} & programs())
        assert "occupied" not in "".join(capsys.readouterr())
        assert os.environ[KEY_VARIABLE] == key
        assert [*place.rglob("*")] == [place / "new"]
        assert not processes(place)


def test_a_folder_whose_name_is_too_long_for_sockets_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The names of Ray's and HAProxy's sockets contain the number of the process."""
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path / ("x" * 40)))
    with ray_folder() as folder:
        assert folder.parent == Path("/tmp")
        assert folder.stat().st_mode & 0o777 == 0o700
    assert not folder.exists()


# Starts two clusters one after the other, and lists the files with their tokens that other accounts
# of the machine could read.
OPEN_HOME = """
import os, stat, sys
from pathlib import Path
import ray
from vlagents_ray.ray_tools.session import joined

os.umask(0o022)

def readable_by_others(path):
    open_folders = all(stat.S_IMODE(folder.stat().st_mode) & 0o001 for folder in path.parents)
    return open_folders and bool(stat.S_IMODE(path.stat().st_mode) & 0o004)

tokens = []
for _ in range(2):
    with joined("local", num_cpus=1):
        token = Path(os.environ["RAY_AUTH_TOKEN_PATH"]).read_text()
        tokens.append(token)
        assert ray.get(ray.remote(lambda: 3).remote()) == 3
        files = [path for place in sys.argv[1:] for path in Path(place).rglob("*") if path.is_file()]
        holders = [path for path in files if token.encode() in path.read_bytes()]
        assert len(holders) == 1, holders
        assert not any(map(readable_by_others, holders)), holders
assert len(set(tokens)) == 2
assert not (Path.home() / ".ray").exists()
assert "RAY_AUTH_TOKEN_PATH" not in os.environ
print("closed to others")
"""


@pytest.mark.ray
def test_the_token_of_a_started_cluster_is_its_own_and_closed_to_other_accounts(
    tmp_path: Path,
) -> None:
    """A process with the token can run code as this user, and home folders are often readable by
    other users.
    """
    with tempfile.TemporaryDirectory() as folder:  # short, because of the names of Ray's sockets
        Path(folder).chmod(0o755)
        home, files = Path(folder, "home"), Path(folder, "t")
        for place in (home, files):
            place.mkdir(mode=0o755)
        environment = {
            name: value for name, value in os.environ.items() if not name.startswith("RAY_AUTH")
        }
        environment |= {"HOME": str(home), "TMPDIR": str(files), "RAY_TMPDIR": str(files)}
        script = tmp_path / "open_home.py"
        script.write_text(OPEN_HOME)
        run = subprocess.run(
            [sys.executable, script, home, files],
            check=False,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
    assert run.stdout.endswith("closed to others\n"), run.stderr
