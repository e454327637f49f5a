"""The warm Ray cluster of this user on this machine, which `vlagents-ray up` keeps for later commands."""

from __future__ import annotations

import contextlib
import fcntl
import importlib.metadata
import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.ray_tools.local_servers import announced, enter
from vlagents_ray.ray_tools.reaper import MARK

_FILE = "warm.json"  # written to the private folder of the cluster when it is ready
_KEEPER = "keeper.lock"  # locked by the keeper, in the same folder
_APP = "app-"  # what the name of a file begins with that is locked by the command that serves an application
_REMOVED = "removed-"  # the same, once the command was killed and the keeper removes the application
_LOCK_S = 5.0  # for the keeper to find out that an application which is just being locked was not abandoned
_REMOVAL_S = 120.0  # for the keeper to remove an application
_LOOK_S = 0.05
_SERVE = "RAY_SERVE_"  # variables that Serve reads in a driver as well
_KEYS = ("VLAGENTS_RAY_KEYS_FILE", "VLAGENTS_RAY_KEYS")  # read where a replica runs
AGAIN = "`vlagents-ray down`, then `vlagents-ray up`; or leave out --address"


@dataclass(frozen=True, slots=True)
class WarmCluster:
    """A warm cluster, with Serve running."""

    url: str  # http://host:port of its servers
    ray_address: str  # host:port
    keeper: int  # id of the process that keeps it
    folder: Path  # of its files
    temporary_files: str  # folder of temporary files, where it was started
    conditions: Mapping[str, str]  # of its start, which a command that uses it shares: `start_conditions`

    @property
    def is_kept(self) -> bool:
        """Whether its keeper runs; without it nothing ends the cluster in order, or starts processes ahead."""
        try:
            descriptor = os.open(self.folder / _KEEPER, os.O_RDONLY)
        except OSError:  # the cluster has ended, with its folder
            return False
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)  # which others that look at the same time share
        except BlockingIOError:
            return True
        finally:
            os.close(descriptor)
        return False


def warm_cluster() -> WarmCluster | None:
    """Return the warm cluster of this user on this machine, with this RAY_TMPDIR or TMPDIR; None if there is none."""
    return next((cluster for cluster, _ in _found()), None)


def this_warm_cluster() -> WarmCluster | None:
    """Return the warm cluster if this process is connected to it; else None."""
    import ray

    cluster = warm_cluster()
    if cluster is None or cluster.ray_address != ray.get_runtime_context().gcs_address:
        return None
    return cluster


def announce_warm(url: str, ray_address: str) -> None:
    """Write the file by which commands of this user find the cluster that this process keeps, which is ready."""
    folder = Path(os.environ[MARK])
    cluster = WarmCluster(url, ray_address, os.getpid(), folder, _temporary_files(), start_conditions())
    new = folder / f"{_FILE}.new"
    new.write_text(json.dumps(asdict(cluster), default=str))
    new.replace(folder / _FILE)


def join_warm(**options: Any) -> WarmCluster:
    """Connect this process to the warm cluster, whose settings of Serve become those of this process.

    Args:
        options: Further options of `ray.init`.

    Raises:
        ConfigError: There is none, it is not kept any longer, or it was started under other conditions or with other
            API keys.
    """
    cluster, environment = next(_found(), (None, {}))
    if cluster is None:
        raise ConfigError("no warm cluster of this user runs on this machine; start one with `vlagents-ray up`")
    require_usable(cluster)
    for name in _KEYS:
        if environment.get(name) != os.environ.get(name):
            raise ConfigError(
                f"{name} is not what it was when the warm cluster was started, and its servers read it there: {AGAIN}"
            )
    serves = {name: value for name, value in environment.items() if name.startswith(_SERVE)}
    enter(f"the warm cluster at {cluster.url}", cluster.ray_address, environment, serves, **options)
    return cluster


def require_usable(cluster: WarmCluster) -> None:
    """Raise `ConfigError` if a warm cluster is not kept any longer, or was started under other conditions."""
    if not cluster.is_kept:
        raise ConfigError(f"the process that kept the warm cluster ({cluster.keeper}) has ended; {AGAIN}")
    for name, here in start_conditions().items():
        if (there := cluster.conditions.get(name)) != here:
            raise ConfigError(f"{name}: the warm cluster was started with {there}, got {here} here; {AGAIN}")


def start_conditions() -> dict[str, str]:
    """Return what a command and a warm cluster must have in common.

    Processes of the cluster have imported this package already, and look up relative paths and modules of the user
    where the cluster was started.
    """
    return {
        "Python": f"{platform.python_version()} in {sys.prefix}",
        "Ray": importlib.metadata.version("ray"),
        "vlagents_ray": f"{importlib.metadata.version('vlagents-ray')} in {Path(__file__).parents[1]}",
        "working directory": os.getcwd(),
        "PYTHONPATH": os.environ.get("PYTHONPATH", ""),
    }


@contextlib.contextmanager
def locked(file: Path) -> Iterator[bool]:
    """Lock a file for the length of the context, unless another process has locked it; yield whether this one has.

    The kernel ends a lock with its process, however that ends.
    """
    with contextlib.ExitStack() as stack:
        try:
            descriptor = os.open(file, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW, 0o600)
            stack.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            mine = os.stat(file).st_ino == os.fstat(descriptor).st_ino  # else it was removed meanwhile
        except OSError:
            mine = False
        yield mine


@contextlib.contextmanager
def only_keeper() -> Iterator[None]:
    """Exclude that another process of this user starts or keeps a warm cluster that would be found in place of ours.

    Raises:
        ConfigError: Another process does.
    """
    Path(_temporary_files()).mkdir(parents=True, exist_ok=True)
    file = Path(_temporary_files()) / f"vlagents-ray-up-{os.getuid()}.lock"
    with locked(file) as mine:
        if not mine:
            raise ConfigError(
                f"another `vlagents-ray up` starts or keeps a warm cluster and has locked {file}: wait for it, or end "
                f"it with `vlagents-ray down`"
            )
        try:
            yield
        finally:
            file.unlink(missing_ok=True)


@contextlib.contextmanager
def kept() -> Iterator[None]:
    """Make this process the keeper of the warm cluster whose folder it has marked."""
    with locked(Path(os.environ[MARK]) / _KEEPER) as mine:
        if not mine:
            raise ConfigError(f"{os.environ[MARK]}: another process keeps the warm cluster of this folder")
        yield


@contextlib.contextmanager
def owned_apps(cluster: WarmCluster, names: Collection[str]) -> Iterator[None]:
    """Own applications of these names in a warm cluster; its keeper removes them if this process is killed.

    Raises:
        ConfigError: Another process owns one of them, or the keeper does not get one removed that was abandoned.
    """
    with contextlib.ExitStack() as stack:
        deadline = time.monotonic() + _LOCK_S
        for name in names:
            file = cluster.folder / f"{_APP}{name}"
            while not stack.enter_context(locked(file)):
                if time.monotonic() > deadline:
                    raise ConfigError(
                        f"another command serves {name!r} in the warm cluster: stop it, use its server, or leave out "
                        f"--address for a Ray of this command's own"
                    )
                time.sleep(_LOOK_S)
            stack.callback(file.unlink, missing_ok=True)
        deadline = time.monotonic() + _REMOVAL_S
        while left := [name for name in names if (cluster.folder / f"{_REMOVED}{name}").exists()]:
            if time.monotonic() > deadline:
                raise ConfigError(f"{left} of a command that was killed are still in the warm cluster: {AGAIN}")
            time.sleep(_LOOK_S)
        yield


@contextlib.contextmanager
def abandoned_apps(folder: Path) -> Iterator[list[str]]:
    """Yield the names of the applications whose owners were killed; others own them after the context."""
    found = []
    for file in folder.glob(f"{_APP}*"):
        with locked(file) as mine:
            if mine:
                found.append(file.rename(folder / f"{_REMOVED}{file.name.removeprefix(_APP)}"))
    yield [file.name.removeprefix(_REMOVED) for file in found]
    for file in found:
        file.unlink(missing_ok=True)


def _found() -> Iterator[tuple[WarmCluster, dict[str, str]]]:
    """Find the warm clusters whose temporary files are where this process's are: jobs of a scheduler share none."""
    for content, environment in announced(_FILE):
        cluster = WarmCluster(
            str(content.get("url")),
            content["ray_address"],
            int(content.get("keeper", 0)),
            Path(environment[MARK]),
            str(content.get("temporary_files")),
            content.get("conditions", {}),  # another version of this package may have written something else
        )
        if cluster.temporary_files == _temporary_files():
            yield cluster, environment


def _temporary_files() -> str:
    return os.environ.get("RAY_TMPDIR") or tempfile.gettempdir()
