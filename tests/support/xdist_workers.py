"""Locks between the processes of pytest-xdist: a test that is marked `alone` runs while no other test does.

Each test takes two file locks. All tests share the second one, except one marked `alone`, which takes it
exclusively. The first lock is held while a test waits for the second, so that tests run in the order they arrive.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

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
    """Make a folder for the Ray clusters of this process, so that they do not find those of other processes.

    None where one process runs all tests. The caller removes the folder.
    """
    if WORKER is None:
        return None
    folder = Path(tempfile.mkdtemp(prefix=f"ray-{WORKER}-"))
    os.environ["RAY_TMPDIR"] = str(folder)
    return folder
