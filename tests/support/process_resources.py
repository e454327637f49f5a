"""The processes that run tests: what one holds, and which tests may run at the same time in those
of pytest-xdist.

The tests that ran in this process before may have left connections, such as Ray's, which come and
go at any time: a test that counts what its process holds is marked `own_process`.

A test that is marked `alone` runs while no other test does. Each test takes two file locks. All
tests share the second one, except one marked `alone`, which takes it exclusively. The first lock is
held while a test waits for the second, so that tests run in the order they arrive.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import settings

_INSIDE = "VLAGENTS_TEST_IN_OWN_PROCESS"


def descriptors() -> set[str]:
    """Open files and sockets; a descriptor whose number is used again counts as another one."""
    found = set()
    for number in os.listdir("/proc/self/fd"):
        # The descriptor of this listing, and those closed meanwhile.
        with contextlib.suppress(FileNotFoundError):
            found.add(f"{number}: {os.readlink(f'/proc/self/fd/{number}')}")
    return found


def running_threads() -> set[threading.Thread]:
    """The threads that run now."""
    return set(threading.enumerate())


def unpooled_threads() -> list[str]:
    """Names of the threads outside of executors, whose pools grow when they must, up to a size."""
    return [thread.name for thread in threading.enumerate() if not re.search(r"_\d+$", thread.name)]


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is marked `own_process` in a pytest of its own, and any other one here."""
    if pyfuncitem.get_closest_marker("own_process") is None or _INSIDE in os.environ:
        return None
    profile = settings.get_current_profile_name()
    options = ["-q", "-p", "no:xdist", "-p", "no:cacheprovider", f"--hypothesis-profile={profile}"]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")}
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            *options,
            f"{pyfuncitem.path}::{pyfuncitem.nodeid.partition('::')[2]}",
        ],
        check=False,
        cwd=pyfuncitem.config.rootpath,
        env=environment | {_INSIDE: "1"},
        capture_output=True,
        text=True,
    )
    if done.returncode != 0:
        pytest.fail(done.stdout + done.stderr, pytrace=False)
    return True


WORKER = os.environ.get("PYTEST_XDIST_WORKER")  # None where one process runs all tests
_RUN = os.environ.get("PYTEST_XDIST_TESTRUNUID", "")
_LOCKS = Path(tempfile.gettempdir())


@contextmanager
def turn(item: pytest.Item) -> Iterator[None]:
    """Run a test beside others, or alone."""
    if WORKER is None:
        yield
        return
    how = fcntl.LOCK_EX if item.get_closest_marker("alone") else fcntl.LOCK_SH
    with _locks("next").open("w") as queue, _locks("running").open("w") as running:
        fcntl.flock(queue, fcntl.LOCK_EX)
        fcntl.flock(running, how)
        fcntl.flock(queue, fcntl.LOCK_UN)
        yield


def _locks(name: str) -> Path:
    return _LOCKS / f"vlagents-ray-tests-{_RUN}-{name}"


def own_ray_folder() -> Path | None:
    """Make a folder for the Ray clusters of this process, so that they do not find those of other
    processes.

    None where one process runs all tests. The caller removes the folder.
    """
    if WORKER is None:
        return None
    folder = Path(tempfile.mkdtemp(prefix=f"ray-{WORKER}-"))
    os.environ["RAY_TMPDIR"] = str(folder)
    return folder
