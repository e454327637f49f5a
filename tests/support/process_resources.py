"""Control of the processes that run tests: which tests may run at the same time in pytest-xdist's
processes, and which tests run in a fresh process.

Earlier tests may have left connections in this process, such as Ray's, which open and close at any
time. So a test that counts the resources of its process is marked `own_process`.

A test that is marked `alone` runs while no other test runs. Each test takes two file locks. All
tests share the second lock, except a test marked `alone`, which takes it exclusively. A test keeps
the first lock while it waits for the second, so that tests run in the order of their arrival.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import settings

_INSIDE = "VLAGENTS_TEST_IN_OWN_PROCESS"


count_frozen = gc.get_freeze_count
_modules_when_frozen = 0  # number of imported modules when the heap was last frozen


def freeze_heap() -> None:
    """Exclude imported modules and collected tests, which live until the end, from garbage
    collection, unless nothing was imported since the last call.

    After some files have imported Ray and torch, each full collection would take 0.1 s, and
    collections a tenth of the time of all tests.
    """
    global _modules_when_frozen  # noqa: PLW0603 - one for each process
    if len(sys.modules) == _modules_when_frozen:
        return
    gc.collect()  # frozen garbage would stay
    gc.freeze()
    if _modules_when_frozen == 0:
        # A control loop checks before each run whether there are frozen objects, and Python counts
        # them all, which takes 0.1 s for a million. They are counted once.
        number = count_frozen()
        gc.get_freeze_count = lambda: number
    _modules_when_frozen = len(sys.modules)


class _FreshProcesses:
    """A pytest process that has imported one file, and forks a fresh process for each test it
    receives.
    """

    def __init__(self, file: Path, root: Path) -> None:
        self.file = file
        asked, self._asks = os.pipe()
        self._answers, answered = os.pipe()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        profile = settings.get_current_profile_name()
        options = ["-q", "-p", "no:xdist", "-p", "no:cacheprovider"]
        own = {_INSIDE: f"{asked} {answered}"}
        inherited = {key: one for key, one in os.environ.items() if not key.startswith("PYTEST_")}
        self._pytest = subprocess.Popen(
            [sys.executable, "-m", "pytest", *options, f"--hypothesis-profile={profile}", file],
            cwd=root,
            env=inherited | own,
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            pass_fds=(asked, answered),
            start_new_session=True,
        )
        os.close(asked)
        os.close(answered)
        self._lines = os.fdopen(self._answers, "rb")

    def failure_of(self, name: str) -> str | None:
        """Run the test of that name in a fresh process; return the failure, or None if the test
        passed.
        """
        with contextlib.suppress(BrokenPipeError):
            os.write(self._asks, json.dumps(name).encode() + b"\n")
        line = self._lines.readline()
        if not line:  # the pytest process has ended
            self._pytest.wait()
            self._log.seek(0)
            return self._log.read().decode(errors="replace")
        failure: str | None = json.loads(line)
        return failure

    def kill(self) -> None:
        """Kill the pytest process and the test that it runs."""
        os.killpg(self._pytest.pid, signal.SIGKILL)
        self.end()

    def end(self) -> None:
        """Let the pytest process end, by closing its input."""
        os.close(self._asks)
        self._pytest.wait()
        self._lines.close()
        self._log.close()


_fresh: _FreshProcesses | None = None  # the pytest process of the file whose tests are running


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is marked `own_process` in a fresh process. Return None for any other test,
    which pytest then runs here.
    """
    global _fresh  # noqa: PLW0603 - one for each process
    if pyfuncitem.get_closest_marker("own_process") is None or _INSIDE in os.environ:
        return None
    if _fresh is None:
        _fresh = _FreshProcesses(pyfuncitem.path, pyfuncitem.config.rootpath)
    try:
        failure = _fresh.failure_of(pyfuncitem.nodeid.partition("::")[2])
    except BaseException:  # the test has reached its time limit
        _fresh.kill()
        _fresh = None
        raise
    if failure is not None:
        pytest.fail(failure, pytrace=False)
    return True


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """End the pytest process of a file when the file's tests are over."""
    global _fresh
    if _fresh is not None and (nextitem is None or nextitem.path != item.path):
        ending, _fresh = _fresh, None
        ending.end()


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """Fork a process for each test that is sent here; this runs in the pytest process of
    `_FreshProcesses`.
    """
    if _INSIDE not in os.environ:
        return None
    asked, answered = map(int, os.environ[_INSIDE].split())
    tests = {item.nodeid.partition("::")[2]: item for item in session.items}
    with os.fdopen(asked, "rb") as names:
        for name in names:
            process = os.fork()
            if process == 0:
                _play_and_exit(tests[json.loads(name)], answered)
            _, status = os.waitpid(process, 0)
            if status != 0:
                ended = f"its process ended with {os.waitstatus_to_exitcode(status)}"
                os.write(answered, json.dumps(ended).encode() + b"\n")
    return True


def _play_and_exit(test: pytest.Item, answered: int) -> None:
    """Run a test, send its failure, and end this process."""
    status = 1
    try:
        test.ihook.pytest_runtest_protocol(item=test, nextitem=None)
        stats = test.config.pluginmanager.get_plugin("terminalreporter").stats
        failed = [*stats.get("failed", []), *stats.get("error", [])]
        texts = []
        for report in failed:
            printed = [text for _, text in report.sections]
            texts.append("\n".join([report.longreprtext, *printed]))
        answer = json.dumps("\n".join(texts) if failed else None)
        os.write(answered, answer.encode() + b"\n")
        status = 0
    finally:
        os._exit(status)


def share_cores() -> None:
    """Limit linear algebra to one thread in each process that is started from now on.

    With one thread per core in each process, threads that wait for each other spin on cores that
    other tests need.
    """
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")


WORKER = os.environ.get("PYTEST_XDIST_WORKER")  # None if one process runs all tests
_RUN = os.environ.get("PYTEST_XDIST_TESTRUNUID", "")
_LOCKS = Path(tempfile.gettempdir())


@contextmanager
def turn(item: pytest.Item) -> Iterator[None]:
    """Run a test next to other tests, or alone, depending on its markers."""
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

    Returns None if one process runs all tests. The caller removes the folder.
    """
    if WORKER is None:
        return None
    folder = Path(tempfile.mkdtemp(prefix=f"ray-{WORKER}-"))
    os.environ["RAY_TMPDIR"] = str(folder)
    return folder
