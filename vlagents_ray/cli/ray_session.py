"""Management of Ray in a command: Ray's logs are written to a file, and the command ends if Ray is
lost.
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import re
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from logging.handlers import RotatingFileHandler
from pathlib import Path

from vlagents_ray.cli.console import err, say_error
from vlagents_ray.errors import ClusterLost, ConfigError
from vlagents_ray.ray_tools.private import LOGGERS, node_of_this_process
from vlagents_ray.ray_tools.session import started_here
from vlagents_ray.signals import is_interrupted, raise_dropped

log = logging.getLogger(__name__)

_LEAVE_S = 10.0  # time limit for the orderly end of a command
# Time limit for the process to end after the command: Ray's shutdown may wait for lost processes.
_EXIT_S = 3.0
_LOOK_S = 1.0  # period of the check for an interrupt that Python dropped
_END_S = 90.0  # time limit after Ctrl-C: a third for Serve, the rest for Ray's shutdown
RESTART = "start it again"
RESUME = "finished episodes are kept: continue with --resume when a cluster is running again"

# Maximum size of a log file, since Serve logs each request; two such files are kept.
_FILE_BYTES = 10_000_000
_FOLLOW_S = 0.3  # period at which the log files of Ray's processes are read
# Patterns of file names in the folder of Ray's logs.
_LOG_FILES = ("worker-*.out", "worker-*.err", "raylet*.err")
_DAEMON = "raylet"
_SERVE_ACTORS = ("HAProxyManager", "ProxyActor", "ServeController")
_ACTOR = ":actor_name:"  # beginning of the line that contains the name of the file's actor
_TITLES = (_ACTOR, ":task_name:", ":job_id:")  # beginnings of lines that identify the process
_LOAD_FAILURES = (
    "Exception in Replica(",
    "Failed to update the deployments",
    "the policy did not load",
)
# Patterns of the beginning of a line in the logs of Serve's processes: of any line, and of a line
# that is not a problem.
_SERVES_LINE = re.compile(r"[A-Z]+ \d{4}-\d\d-\d\d \d\d:")
_SERVES_INFO = re.compile(r"(INFO|DEBUG) \d{4}-\d\d-\d\d \d\d:")
# Warnings about intended settings of `own_ray`: Ray listens on loopback, has a token and does not
# handle signals.
_INTENDED = (
    "won't accept connections from HAProxy on other nodes",
    "Token authentication is enabled",
    "SIGTERM handler is not set",
)


@contextlib.contextmanager
def quiet_ray(name: str | None, started: threading.Event | None = None) -> Iterator[Path | None]:
    """Keep the logs of Ray, Serve and HAProxy off the terminal, except for problems.

    The context begins before Ray is started.

    Args:
        name: The prefix of the log file's name; None keeps no log.
        started: An event that is set when the server is ready. Until then, the traceback of a
            policy that does not load is also kept off the terminal, since the error of the command
            contains the last line of the traceback.

    Yields:
        The log file, which only this user can read, and which is removed at the end if it is empty;
        None without a name.
    """
    file = None
    handler = None
    if name is not None:
        descriptor, path = tempfile.mkstemp(prefix=f"{name}-", suffix=".log")
        os.close(descriptor)
        file = Path(path)
        handler = RotatingFileHandler(path, maxBytes=_FILE_BYTES, backupCount=1)

    terminal = _Terminal(handler, started)
    loggers = [logging.getLogger(logger_name) for logger_name in LOGGERS]
    for logger in loggers:
        logger.addFilter(terminal.keep_problem)

    ended = threading.Event()
    follower = threading.Thread(
        target=_follow, args=(terminal, ended), name="ray-logs", daemon=True
    )
    if name is not None:
        follower.start()

    try:
        yield file
    except ConfigError:
        if terminal.failing and file is not None:
            err.print(f"traceback, and log of Ray, Serve and HAProxy: {file}")
        raise
    finally:
        for logger in loggers:
            logger.removeFilter(terminal.keep_problem)
        ended.set()
        if file is not None and handler is not None:
            follower.join()
            handler.close()
            if file.stat().st_size == 0:  # e.g. if the port is in use
                file.unlink()


class _Terminal:
    """Passes problems in the logs of Ray and Serve to the terminal, and all other lines to the log
    file.
    """

    def __init__(self, log_file: logging.Handler | None, started: threading.Event | None) -> None:
        self.failing: set[str] = set()  # processes that are printing a policy's traceback
        self._log_file = log_file
        self._started = started

    def keep_problem(self, record: logging.LogRecord) -> bool:
        """Filter a record of this process, for `logging`: write a record that is not a problem to
        the log file.
        """
        text = record.getMessage()
        if _is_problem(text, record.levelno):
            return True
        self._write_log(text)
        return False

    def print_line(self, actor: str, process: str, line: str) -> None:
        """Print a line of another process if it is a problem; otherwise write it to the log file.

        Args:
            actor: The name of the actor in the process.
            process: The number of the process, or "raylet".
            line: The line.
        """
        level = logging.INFO if _SERVES_INFO.match(line) else logging.WARNING
        text = f"({actor} pid={process}) {line}"
        if any(failure in line for failure in _LOAD_FAILURES):
            self.failing.add(process)
        elif _SERVES_LINE.match(line):
            self.failing.discard(process)

        is_starting = self._started is not None and not self._started.is_set()
        is_traceback = is_starting and process in self.failing
        # A signal to the whole process group also ends Ray's daemon and HAProxy. The daemon then
        # prints possible causes, and Serve's actors print that HAProxy crashed.
        is_consequence = is_interrupted() and (process == _DAEMON or actor in _SERVE_ACTORS)
        if is_consequence or is_traceback or not _is_problem(line, level):
            self._write_log(text)
        else:
            sys.stderr.write(f"{text}\n")

    def _write_log(self, text: str) -> None:
        """Write a line to the log file, if there is one."""
        if self._log_file is not None:
            self._log_file.emit(logging.LogRecord("ray", logging.INFO, "", 0, text, None, None))


def _follow(terminal: _Terminal, ended: threading.Event) -> None:
    """Forward the output of Ray's processes until the event `ended` is set; runs on its own thread.

    This replaces Ray's `log_to_driver`, which has no filter.
    """
    files: dict[Path, _LogFile] = {}
    over = False
    while not over:
        over = ended.wait(_FOLLOW_S)
        node = node_of_this_process()
        if node is not None and started_here():
            folder = Path(node.get_logs_dir_path())
            for pattern in _LOG_FILES:
                for path in folder.glob(pattern):
                    if path not in files:
                        files[path] = _LogFile(path)

        for file in files.values():
            for line in file.new_lines():
                terminal.print_line(file.actor, file.process, line)


class _LogFile:
    """A log file of a Ray process, which is read while the process writes it."""

    def __init__(self, path: Path) -> None:
        self.actor = "ray"
        # "raylet", or the last part of the name "worker-WORKER-JOB-PID".
        self.process = path.stem.rpartition("-")[2]
        self._path = path
        self._offset = 0

    def new_lines(self) -> Iterator[str]:
        """Yield the complete lines since the last call, without the lines that identify the
        process.
        """
        try:
            if self._path.stat().st_size < self._offset:  # the file was rotated
                self._offset = 0
            with self._path.open("rb") as file:
                file.seek(self._offset)
                text, end, _ = file.read().rpartition(b"\n")
        except OSError:  # the file was removed
            return

        self._offset += len(text) + len(end)
        for line in text.decode(errors="replace").split("\n"):
            if line.startswith(_ACTOR):
                self.actor = line.removeprefix(_ACTOR)
            elif line and not line.startswith(_TITLES):
                yield line


def _is_problem(text: str, level: int) -> bool:
    """Return whether a log line is a warning or an error, other than the intended warnings."""
    is_intended = any(warning in text for warning in _INTENDED)
    return level >= logging.WARNING and not is_intended


@contextlib.contextmanager
def exit_if_ray_is_lost(cure: str) -> Iterator[RayLoss]:
    """End the process with status 1 if Ray is lost within the context.

    The command has 10 s for an orderly end.

    Args:
        cure: The advice in the error.

    Yields:
        The observer of Ray.
    """
    # Import Ray before the thread starts: a module that two threads import at the same time is
    # incomplete in one of the threads.
    import ray  # noqa: F401

    loss = RayLoss(cure)
    threading.Thread(target=loss.watch, name="ray-lost", daemon=True).start()
    try:
        yield loss
    except ClusterLost as error:
        loss.error = error
        raise
    except KeyboardInterrupt:  # includes SIGTERM, which may also have ended Ray
        loss.interrupted = True
        raise
    except Exception as error:
        if loss.error is not None:  # Ray's error is a consequence of the interrupt
            raise loss.error from error
        raise
    finally:
        loss.ending.set()


class RayLoss:
    """Watches whether the Ray that this process has joined is lost.

    Args:
        cure: The advice in the error.
    """

    def __init__(self, cure: str) -> None:
        self.error: ClusterLost | None = None
        self.interrupted = False
        # Set when the command has ended, or is about to print its error.
        self.ending = threading.Event()
        self._cure = cure
        self._lost = threading.Event()

    def wait(self) -> None:
        """Wait until Ray is lost; after an interrupt, the process ends within `_END_S`.

        Raises:
            ClusterLost: Ray is lost.
            KeyboardInterrupt: The command was interrupted.
        """
        try:
            while not self._lost.wait(_LOOK_S):
                raise_dropped()
        except KeyboardInterrupt:
            self.ending.set()
            # `faulthandler` also prints the stacks of all threads.
            faulthandler.dump_traceback_later(_END_S, exit=True)
            raise
        if self.error is not None:
            raise self.error

    def watch(self) -> None:
        """Watch Ray until the command ends, and end the process if Ray is lost; runs on its own
        thread.
        """
        while self.error is None and not self.ending.is_set():
            self._watch_ray()
        if self.error is None:
            return

        self._lost.set()
        message = f"{type(self.error).__name__}: {self.error}"
        if self.ending.wait(_LEAVE_S):
            if self.interrupted:
                return
            time.sleep(_EXIT_S)
        else:
            say_error(message)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(1)  # the reaper ends all other processes

    def _watch_ray(self) -> None:
        """Watch the Ray that this process has joined, until it leaves Ray or Ray is lost."""
        from vlagents_ray.ray_tools.head_monitor import PERIOD_S, HeadMonitor

        head: HeadMonitor | None = None
        while not self.ending.wait(PERIOD_S):
            node = node_of_this_process()
            if node is None or (head is not None and head.node is not node):
                return
            try:
                if head is None:
                    head = HeadMonitor(self._cure)
                head.answers()
            except ClusterLost as error:
                if node_of_this_process() is node:  # Ray is lost, unless this process is leaving it
                    self.error = error
                return
            except Exception as error:  # noqa: BLE001 - Ray may raise any error at its start or end
                log.debug("Ray was not watched: %s", error)
