"""The servers of this user on this machine, and `join`, which connects a program to the Ray cluster of one of them.

A server's Ray is on the loopback address, in a private folder, and requires a token. `ray.init("auto")` finds it, but
connects to another address of this machine, and waits there for minutes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.ray_tools.reaper import MARK

_FILE = "server.json"  # written to the private folder of a server's Ray when the server is ready
_DAEMON = b"raylet"
_ADDRESS = b"--gcs-address="
_MODE, _TOKENS = "RAY_AUTH_MODE", ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")
_ALONE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"  # "0": Ray uses loopback addresses as they are


@dataclass(frozen=True, slots=True)
class LocalServer:
    """A running server on this machine, started by `vlagents-ray serve`."""

    url: str  # http(s)://host:port
    apps: tuple[str, ...]  # its applications, reached at serve://APP inside the cluster
    ray_address: str  # host:port of its Ray cluster


def join(server: str | None = None, **options: Any) -> LocalServer:
    """Connect this process to the Ray cluster of a server on this machine, instead of `ray.init`.

    Actors and tasks of this process then run in that cluster, with the server's Python and with the modules of this
    process's script and working directory. `RemoteAgent("serve://APP")` reaches the policy from this process and from
    each of them. They end with the server. `ray.shutdown()` leaves the cluster; the server continues.

    Args:
        server: The URL of the server, or the name of one of its applications; required if several servers run.
        options: Further options of `ray.init`, such as `log_to_driver`.

    Returns:
        The URL of the server, its applications, and the address of its Ray cluster.

    Raises:
        ConfigError: No server of this user is ready on this machine, several are and `server` is None, or this process
            is in another Ray cluster.
    """
    import ray

    from vlagents_ray.ray_tools.private import reread_authentication_mode, use_loopback

    chosen, environment = _chosen(server)
    if ray.is_initialized():
        if ray.get_runtime_context().gcs_address == chosen.ray_address:
            return chosen
        raise ConfigError(
            f"got a process in another Ray cluster, {ray.get_runtime_context().gcs_address}; want it in that of "
            f"{chosen.url}: call ray.shutdown() before, or join() in place of ray.init()"
        )
    if os.environ.get(_MODE, "token").lower() != "token":
        raise ConfigError(f"{_MODE}={os.environ[_MODE]}: the Ray of {chosen.url} needs its token; unset {_MODE}")
    tokens = {one: environment[one] for one in _TOKENS if environment.get(one)}
    if not tokens and environment.get("HOME"):  # where Ray keeps the token, which may not be this program's home
        tokens = {_TOKENS[1]: f"{environment['HOME']}/.ray/auth_token"}
    for one in _TOKENS:
        os.environ.pop(one, None)
    os.environ.update({_MODE: "token", _ALONE: "0"} | tokens)
    use_loopback(True)  # Ray read the variables when it was imported
    reread_authentication_mode()
    ray.init(chosen.ray_address, **{"log_to_driver": True, "logging_level": "WARNING"} | options)
    return chosen


def announce(url: str, apps: Mapping[str, str], ray_address: str) -> None:
    """Write the file by which programs of this user find the server of this process's Ray, which is ready.

    Args:
        url: The server's URL.
        apps: Its applications by name.
        ray_address: The address of its Ray cluster, host:port.
    """
    new = Path(os.environ[MARK]) / f"{_FILE}.new"
    new.write_text(json.dumps(asdict(LocalServer(url, tuple(apps), ray_address))))
    new.replace(new.with_name(_FILE))


def local_servers() -> list[LocalServer]:
    """List the servers of this user on this machine that are ready, sorted by URL."""
    return sorted((server for server, _ in _found()), key=lambda server: server.url)


def _chosen(wanted: str | None) -> tuple[LocalServer, dict[str, str]]:
    """Return the server that `wanted` names, and the environment of its Ray's daemon."""
    found = list(_found())
    url = None if wanted is None else wanted.rstrip("/").replace("://localhost:", "://127.0.0.1:")
    fitting = [one for one in found if wanted is None or url == one[0].url or wanted in one[0].apps]
    if len(fitting) == 1:
        return fitting[0]
    there = ", ".join(sorted(f"{one.url} ({', '.join(one.apps)})" for one, _ in found))
    if fitting:
        raise ConfigError(f"got {len(fitting)} servers on this machine, {there}; say which: join('{found[0][0].url}')")
    if found:
        raise ConfigError(f"got {wanted!r}, want the URL or an application of a server on this machine: {there}")
    raise ConfigError(
        "no server of this user is ready on this machine; start one with `vlagents-ray serve POLICY`. Those of other "
        "users, and on other machines, are reached at their URL: RemoteAgent('http://HOST:8000')"
    )


def _found() -> Iterator[tuple[LocalServer, dict[str, str]]]:
    """Yield the servers of this user on this machine, each with the environment of its Ray's daemon."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words = (process / "cmdline").read_bytes().split(b"\0")
            if Path(os.fsdecode(words[0])).name != os.fsdecode(_DAEMON) or process.stat().st_uid != os.getuid():
                continue
            pairs = (one.partition(b"=") for one in (process / "environ").read_bytes().split(b"\0"))
            environment = {os.fsdecode(key): os.fsdecode(value) for key, _, value in pairs}
            content = json.loads((Path(environment[MARK]) / _FILE).read_text())
            address = f"{_ADDRESS.decode()}{content['ray_address']}"
        except (OSError, KeyError, ValueError, TypeError):  # it has ended, is another user's, or not announced
            continue
        # What was killed may have left the folder, and another cluster may use it now.
        if any(address in os.fsdecode(word) for word in words):
            yield LocalServer(content["url"], tuple(content["apps"]), content["ray_address"]), environment
