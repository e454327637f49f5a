"""Settings, order and fixtures of all tests."""

from __future__ import annotations

import functools
import gc
import logging
import os
import shutil
import signal
from collections.abc import Generator, Iterator
from pathlib import Path

import many  # noqa: F401 - registers profiles
import pytest
import shared_ray as shared
import typer.main
import typer.testing
from needs import (
    assets,
    left_out,
    mark_tier,
    nothing_else,
    pytest_make_collect_report,
    pytest_runtest_makereport,
    skip_what_is_missing,
)
from process_resources import (
    freeze_heap,
    own_ray_folder,
    pytest_pyfunc_call,
    pytest_runtest_teardown,
    pytest_runtestloop,
    share_cores,
    turn,
)
from programs import RunPrograms
from schedule import pytest_terminal_summary, pytest_xdist_make_scheduler, seconds, unit
from verified import VerifyingTests

from vlagents_ray.envs.graphics import prepare_rendering

__all__ = [
    "pytest_make_collect_report",
    "pytest_pyfunc_call",
    "pytest_runtest_makereport",
    "pytest_runtest_teardown",
    "pytest_runtestloop",
    "pytest_terminal_summary",
    "pytest_xdist_make_scheduler",
]

# Tests never use the network. These variables are set before any module that reads them is
# imported.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("WANDB_MODE", "offline")
# By default Ray starts a worker for each CPU before any task needs it. That takes a second of CPU
# for each Ray instance of a test run.
os.environ.setdefault("RAY_prestart_worker_first_driver", "0")
os.environ.setdefault("RAY_enable_worker_prestart", "0")
# As on a cluster (cluster/ray/environment.sh): by default Ray's workers run at a low priority, so
# the workers of one test would wait for all other work of the tests.
os.environ.setdefault("RAY_worker_niceness", "0")
# A shell that starts a job in the background makes the job and its children ignore Ctrl-C, which
# tests send to servers.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
prepare_rendering()
if (simpler := assets("simpler")) is not None:
    os.environ.setdefault("MS_ASSET_DIR", str(simpler))  # ManiSkill reads it once per process
_RAY_FOLDER = own_ray_folder()

# The slowest files run first, so that the processes that share the tests end at about the same
# time. Files that use the shared Ray run after all slow files, so that each process starts the
# shared Ray only once: some slow files start their own Ray, which takes CPU, and others mostly
# wait.
_ORDER = ("hosts", "server", "ray", shared.FIXTURE, "vulkan", "sim", "torch")
_SHARED = _ORDER.index(shared.FIXTURE)
_shared_files: set[Path] = set()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--verified",
        action="store_true",
        help="record the outcomes of the tests marked `verifies` and `program`, as JSON",
    )


def pytest_configure(config: pytest.Config) -> None:
    # Under `nohup`, this process and each program that a test starts ignore the hangup signals that
    # tests send. A program inherits SIG_IGN, but no handler. The processes of pytest-xdist inherit
    # SIG_IGN, and set the handler themselves.
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN and not config.getoption(
        "numprocesses", None
    ):
        signal.signal(signal.SIGHUP, _ignore_hangup)
    if config.getoption("numprocesses", None):
        share_cores()
    if config.getoption("--verified"):
        config.pluginmanager.register(VerifyingTests())
        config.pluginmanager.register(RunPrograms())


def _ignore_hangup(*_: object) -> None: ...


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip the collection of a file if `-m` deselects all of its tests."""
    return left_out(collection_path, config.option.markexpr) or None


def pytest_collectstart() -> None:
    """Disable garbage collection until all tests are collected, since the collected objects live
    until the end.
    """
    gc.disable()


def pytest_itemcollected(item: pytest.Item) -> None:
    """Add the marker of the shared Ray, and the marker of the test's tier."""
    if shared.FIXTURE in getattr(item, "fixturenames", ()):
        item.add_marker("ray")
        _shared_files.add(item.path)
    mark_tier(item)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Sort the tests. The tests of a file stay together and share what the file starts, except
    tests that run alone.
    """
    places: dict[str, int] = {}
    for item in items:
        if " at 0x" in item.nodeid:  # processes that share the tests must collect identical names
            raise pytest.UsageError(
                f"{item.nodeid}: got an address in a test's name; name its parameters with ids="
            )
        marked = {marker.name for marker in item.iter_markers()}
        place = next((number for number, name in enumerate(_ORDER) if name in marked), len(_ORDER))
        if item.path in _shared_files:
            place = _SHARED
        places[unit(item.nodeid)] = min(places.get(unit(item.nodeid), place), place)
    took = seconds(config)

    def phase(name: str) -> int:
        """Return -1 if the unit runs before the files that use the shared Ray, 0 for these files,
        and 1 if it runs after them.
        """
        if places[name] == _SHARED:
            return 0
        return -1 if places[name] < _SHARED or took[name] else 1

    def order(item: pytest.Item) -> tuple[bool, int, float, int]:
        name = unit(item.nodeid)
        # A test that runs alone comes last, when no other test is left.
        alone = item.get_closest_marker("alone") is not None
        return alone, phase(name), -took[name], places[name]

    items.sort(key=order)


def pytest_collection_finish() -> None:
    """Turn garbage collection on again, but only for objects that tests make."""
    freeze_heap()
    gc.enable()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a test that this machine cannot run, and stop the shared Ray before a file that does not
    use it.
    """
    skip_what_is_missing(item)
    if item.path not in _shared_files:
        shared.stop()


@pytest.fixture(autouse=True, scope="session")
def commands_built_once() -> Iterator[None]:
    """Build the commands of an application once per process. Otherwise Typer's test runner would
    build all commands again for each call.
    """
    with pytest.MonkeyPatch.context() as patch:
        build = functools.cache(typer.main.get_command)
        patch.setattr(typer.testing, "_get_command", build)
        yield


@pytest.fixture(scope="module")
def shared_ray() -> None:
    """Start the Ray instance that several test files share; `shared_ray.shared_server` serves
    policies on it.
    """
    shared.start()


@pytest.fixture(autouse=True, scope="module")
def levels_of_loggers() -> Iterator[None]:
    """Restore the levels of all loggers after each file, since `ray.init` sets the level of Ray's
    logger for the whole process.
    """
    loggers = [
        one for one in logging.root.manager.loggerDict.values() if isinstance(one, logging.Logger)
    ]
    levels = [one.level for one in loggers]
    yield
    for logger, level in zip(loggers, levels, strict=True):
        logger.setLevel(level)


@pytest.fixture(autouse=True, scope="module")
def frozen_imports() -> Iterator[None]:
    """Exclude what a file has imported from garbage collection, when its tests are over."""
    yield
    freeze_heap()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Wait until the test may run, before its duration is measured."""
    with turn(item), nothing_else(item):
        return (yield)


def pytest_sessionfinish() -> None:
    shared.stop()


def pytest_unconfigure() -> None:
    """Delete the Ray folder of this test run."""
    if _RAY_FOLDER is not None:
        shutil.rmtree(_RAY_FOLDER, ignore_errors=True)
