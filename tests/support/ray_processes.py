"""Find, start and stop processes of servers and of Ray.

The processes of a Ray with a separate folder (RAY_TMPDIR, --temp-dir) are identified by this
folder. `serving` runs `vlagents-ray serve` like a user; `leaked` searches files, command lines and
environments, where other processes could read a secret.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import signal
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
from eval_fakes import wait_for
from readme_blocks import ENV

from vlagents_ray.ray_tools.reaper import has_open_files, is_titled
from vlagents_ray.serve.ports import free_port


def words(process: psutil.Process) -> list[str]:
    """Return the command line of a process; empty if the process has ended or is ending."""
    try:
        return process.cmdline()
    except psutil.Error:
        return []


@contextmanager
def ray_folder() -> Iterator[Path]:
    """Yield a folder for a separate Ray, which is killed at the end. The path is short, because the
    names of sockets are limited.
    """
    folder = Path(tempfile.mkdtemp(prefix="r"))
    try:
        yield folder
    finally:
        end(folder)
        shutil.rmtree(folder, ignore_errors=True)


def processes(folder: Path, named: str = "") -> list[int]:
    """Return the processes of the Ray whose files are in `folder`; with `named`, only those whose
    program contains this text.
    """
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command = (process / "cmdline").read_bytes()
            ours = str(folder).encode() in command + (process / "environ").read_bytes()
            ours = ours or (is_titled(process) and has_open_files(process, str(folder)))
        except OSError:  # the process has ended, or belongs to another user
            continue
        # The text after the first NUL may be a rest of the environment that setproctitle left.
        program = command.partition(b"\0")[0]
        if ours and named.encode() in program:
            found.append(int(process.name))
    return found


def wait_for_end(folder: Path, *named: str) -> None:
    """Wait until no process of that Ray whose program contains one of `named` is left; fail with
    the remaining ones if they do not end.
    """
    try:
        wait_for(lambda: not any(processes(folder, name) for name in named))
    except TimeoutError as error:
        left = {pid: _said(pid) for name in named for pid in processes(folder, name)}
        raise AssertionError(f"still running: {left}") from error


def _said(pid: int) -> str:
    try:
        command = (Path("/proc") / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ")
        state = (
            (Path("/proc") / str(pid) / "status").read_text().partition("State:")[2].split("\n")[0]
        )
    except OSError:
        return "just ended"
    return f"{command[:200].decode(errors='replace')} ({state.strip()})"


def end(folder: Path) -> None:
    """Kill the remaining processes of that Ray, since two agents notice only after a minute that it
    was killed.
    """
    for pid in processes(folder):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    wait_for(lambda: not processes(folder))


START_S, STOP_S = 180, 180


def free_address() -> str:
    """Return a free "host:port"."""
    return f"127.0.0.1:{free_port()}"


@contextlib.contextmanager
def serving(
    policy: str, log: Path, address: str | None = None, *options: str, cwd: Path | None = None
) -> Iterator[str]:
    """Run a server during the context, on a free port unless `address` is given, and yield
    "host:port" once it is healthy.

    With a `cwd`, the command runs there like a user's command, without the folders that tests add
    to PYTHONPATH.
    """
    address = address or free_address()
    command = ["vlagents-ray", "serve", policy, "--port", address.rpartition(":")[2], *options]
    with log.open("w") as output:
        server = subprocess.Popen(
            [shutil.which(command[0], path=ENV["PATH"]) or command[0], *command[1:]],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            cwd=cwd,
            # PYTHONPATH as tests may have changed it in the meantime.
            env=ENV if cwd is not None else ENV | {"PYTHONPATH": os.environ.get("PYTHONPATH", "")},
        )
    try:
        deadline = time.monotonic() + START_S
        while not healthy(address):
            assert server.poll() is None, f"{shlex.join(command)} ended:\n{log.read_text()}"
            assert time.monotonic() < deadline, (
                f"{shlex.join(command)} is not healthy:\n{log.read_text()}"
            )
            time.sleep(0.2)
        yield address
    finally:
        server.terminate()  # equivalent to Ctrl-C, which processes in a shell's background ignore
        try:
            server.wait(STOP_S)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()
            raise


def healthy(address: str) -> bool:
    """Return whether the server answers and its policy is loaded."""
    try:
        with urllib.request.urlopen(f"http://{address}/healthz", timeout=5) as answer:
            return answer.status == 200
    except (urllib.error.URLError, OSError):
        return False


def leaked(secret: str, folders: Iterable[Path]) -> list[str]:
    """Return the files in `folders`, the command lines, and the environments of other processes
    that contain the secret.
    """
    sought = secret.encode()
    files = [file for folder in folders for file in folder.rglob("*") if file.is_file()]
    for process in Path("/proc").glob("[0-9]*"):
        files += [
            process / "cmdline",
            *([process / "environ"] if int(process.name) != os.getpid() else []),
        ]
    found = []
    for file in files:
        try:
            if sought in file.read_bytes():
                found.append(str(file))
        except OSError:  # the process has ended, or belongs to another user
            continue
    return found
