"""The open files and running threads of this process, to check that a test leaves none of its own behind.

The tests that ran in this process before may have left connections, such as Ray's, which come and go at any time: a
test that counts what its process holds is marked `own_process`.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import threading

import pytest
from hypothesis import settings

_INSIDE = "VLAGENTS_TEST_IN_OWN_PROCESS"


def descriptors() -> set[str]:
    """Open files and sockets; a descriptor whose number is used again counts as another one."""
    found = set()
    for number in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # the descriptor of this listing, and those closed meanwhile
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
        [sys.executable, "-m", "pytest", *options, f"{pyfuncitem.path}::{pyfuncitem.nodeid.partition('::')[2]}"],
        check=False,
        cwd=pyfuncitem.config.rootpath,
        env=environment | {_INSIDE: "1"},
        capture_output=True,
        text=True,
    )
    if done.returncode != 0:
        pytest.fail(done.stdout + done.stderr, pytrace=False)
    return True
