"""The readiness of HAProxy, judged from its statistics of an application's replicas, and its
settings.
"""

from __future__ import annotations

import itertools
import re
import socket
import subprocess
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, HTTPServer, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from eval_fakes import wait_for
from ray.serve._private.constants import (
    RAY_SERVE_HAPROXY_HEALTH_CHECK_DOWNINTER,
    RAY_SERVE_HAPROXY_HEALTH_CHECK_FASTINTER,
)

from vlagents_ray.client.connection import FROZEN_S
from vlagents_ray.client.transports.http import refusal
from vlagents_ray.errors import NoReplica, PolicyUnavailable
from vlagents_ray.ray_tools.reaper import MARK
from vlagents_ray.serve.launch.haproxy import (
    _CHECK_FAILURES,
    _CHECK_INTERVAL,
    _CONNECTIONS_PER_ADDRESS,
    ROBOTS,
    _write_launcher,
    close_port,
    haproxy_binary,
    open_port,
    wait_for_haproxy,
)
from vlagents_ray.serve.ports import free_port

pytestmark = pytest.mark.slow  # HAProxy's own timeouts must pass

MOST_CONNECTIONS = _CONNECTIONS_PER_ADDRESS + 50
UP, DOWN = "http-app,SERVE_REPLICA::1,UP", "http-app,SERVE_REPLICA::1,DOWN"


@contextmanager
def statistics(*rows: str) -> Iterator[int]:
    """Serve a page of HAProxy statistics, and yield the port."""

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write("\n".join(["# pxname,svname,status", *rows, ""]).encode())

        def log_message(self, *_: Any) -> None:
            """Suppress the log."""

    with HTTPServer(("127.0.0.1", 0), Page) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.server_port
        finally:
            server.shutdown()
            thread.join()


def serving(running: int) -> Any:
    """Return a stand-in for Serve with one application of `running` replicas."""
    policy = SimpleNamespace(replica_states={"RUNNING": running})
    application = SimpleNamespace(deployments={"Policy": policy})
    return SimpleNamespace(status=lambda: SimpleNamespace(applications={"app": application}))


@pytest.mark.parametrize(("running", "rows"), [(1, [UP]), (0, []), (0, [DOWN])])
def test_it_reaches_all_that_run(running: int, rows: list[str]) -> None:
    """An application may lose all replicas before HAProxy's statistics are read, which must not
    block the start.
    """
    with statistics(*rows) as port:
        wait_for_haproxy(serving(running), {"app": "/"}, port, time.monotonic() + 30)


@pytest.mark.parametrize(("running", "rows"), [(1, []), (1, [DOWN]), (2, [UP])])
def test_it_is_late_while_a_replica_that_runs_is_not_reached(running: int, rows: list[str]) -> None:
    with statistics(*rows) as port, pytest.raises(PolicyUnavailable, match="'app'"):
        wait_for_haproxy(serving(running), {"app": "/"}, port, time.monotonic())


@contextmanager
def started(folder: Path, settings: str) -> Iterator[str]:
    """Start HAProxy with these settings, in which PORT is its own port and ADDRESS accepts
    connections but never answers, and yield its URL.
    """
    port = free_port()
    config = folder / "haproxy.cfg"
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        common = (
            f"global\n    maxconn {MOST_CONNECTIONS}\n"
            f"    stats socket {folder / 'admin'} level admin\n"
            "defaults\n    mode http\n"
            "    timeout connect 60s\n    timeout client 60s\n    timeout server 60s\n"
            "frontend http_frontend\n    bind 127.0.0.1:PORT\n"
        )
        text = (common + settings).replace("PORT", str(port))
        config.write_text(text.replace("ADDRESS", address))
        open_port(folder)
        command = [str(_write_launcher(folder, str(haproxy_binary()))), "-db", "-f", str(config)]
        with subprocess.Popen(command) as proxy:
            try:
                wait_for(lambda: listens(port), 30)
                yield f"http://127.0.0.1:{port}"
            finally:
                proxy.terminate()


@contextmanager
def proxied(folder: Path, *servers: str, settings: str = "") -> Iterator[str]:
    """Yield the URL of a HAProxy in front of an application with these servers."""
    frontend = (
        "    acl routes path -i /-/routes\n"
        '    http-request return status 200 content-type text/plain string "all applications" '
        "if routes\n"
        "    default_backend http-app\n"
    )
    lines = "".join(f"    server {one}\n" for one in servers)
    with started(folder, f"{frontend}backend http-app\n{settings}{lines}") as url:
        yield url


def seconds(setting: str) -> float:
    """Return a time in HAProxy's notation in seconds."""
    number, unit = re.fullmatch(r"(\d+)(ms|s)", setting).groups()  # type: ignore[union-attr]
    return int(number) / (1000 if unit == "ms" else 1)


REPLICA, FALLBACK = (
    "SERVE_REPLICA_app-Policy-1 ADDRESS",
    "SERVE_PROXY_ACTOR-fallback ADDRESS backup",
)
UPGRADE = {
    "connection": "upgrade",
    "upgrade": "websocket",
    "sec-websocket-key": "dGhlIHNhbXBsZSBub25jZQ==",
}
needs_haproxy = pytest.mark.skipif(haproxy_binary() is None, reason="HAProxy is not installed")


SERVES_OWN = """\
frontend prometheus
    bind 127.0.0.1:9000
frontend http_frontend
    bind 127.0.0.1:8000
backend http-app
    server {server}
listen outside
    mode tcp
    bind 192.0.2.7:8443 ssl
    server inside 127.0.0.1:8000
listen stats
  bind 127.0.0.1:9001
"""


def binds(launcher: Path, config: Path, server: str) -> list[str]:
    """Return the addresses at which HAProxy would listen, with the settings that Serve writes when
    `server` is in the backend.
    """
    config.write_text(SERVES_OWN.format(server=server))
    subprocess.run([launcher, "-f", config], check=True)
    return re.findall(r"^ *bind (\S+)", config.read_text(), re.MULTILINE)


@pytest.mark.parametrize("begins_empty", [False, True])
def test_clients_are_refused_until_the_first_replica_runs_and_when_the_server_stops(
    begins_empty: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """openpi's client waits for a server whose port is closed, but fails if the handshake is
    rejected or hangs.
    """
    monkeypatch.setenv(MARK, str(tmp_path))
    launcher, config = _write_launcher(tmp_path, "/bin/true"), tmp_path / "haproxy.cfg"
    own, public = ["127.0.0.1:9000", "127.0.0.1:9001"], ["127.0.0.1:8000", "192.0.2.7:8443"]
    if begins_empty:
        open_port(tmp_path)
    assert set(binds(launcher, config, FALLBACK)) == {*own, *(public if begins_empty else [])}
    assert set(binds(launcher, config, REPLICA)) == {*own, *public}
    # When the last replica has ended, clients still get an answer that explains it.
    assert set(binds(launcher, config, FALLBACK)) == {*own, *public}
    close_port()  # the server stops
    assert set(binds(launcher, config, REPLICA)) == set(own)
    assert set(binds(launcher, config, FALLBACK)) == set(own)


@needs_haproxy
def test_the_port_of_a_stopping_server_is_closed_at_once_and_open_connections_get_503(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The replica is down, and Serve's own proxy would answer that it knows no such path."""
    monkeypatch.setenv(MARK, str(tmp_path))
    with toggled("Serve's proxy") as (fallback, up):
        up.set()
        servers = (f"{REPLICA} disabled", f"SERVE_PROXY_ACTOR-f 127.0.0.1:{fallback} backup")
        with proxied(tmp_path, *servers) as url:
            kept = HTTPConnection(url.removeprefix("http://"), timeout=30)
            kept.request("GET", "/act")
            with kept.getresponse() as before:
                assert before.status == 200
                before.read()
            close_port()

            kept.request("GET", "/act")
            with kept.getresponse() as after:
                assert after.status == 503
                kind = after.headers["content-type"]
                assert isinstance(refusal(503, kind, after.read()), NoReplica)
            kept.close()
            assert not listens(int(url.rpartition(":")[2]))


def test_a_cluster_whose_haproxy_serves_others_opens_its_port_at_once(tmp_path: Path) -> None:
    launcher = _write_launcher(tmp_path, "/bin/true", alone=False)
    assert "127.0.0.1:8000" in binds(launcher, tmp_path / "haproxy.cfg", FALLBACK)


@needs_haproxy
@pytest.mark.parametrize(
    ("servers", "path", "body"),
    [
        ([REPLICA, FALLBACK], "/app/healthz", None),  # a frozen replica
        ([FALLBACK], "/app/healthz", None),
        ([FALLBACK], "/v1/metadata", None),
        ([FALLBACK], "/v1/act", b"{}"),
    ],
)
def test_without_a_replica_that_answers_haproxy_does(
    servers: list[str], path: str, body: bytes | None, tmp_path: Path
) -> None:
    """Serve keeps requests until a replica runs, which may be forever if no node has the required
    GPU.
    """
    with proxied(tmp_path, *servers) as url:
        with pytest.raises(urllib.error.HTTPError, match="503") as refused:
            urllib.request.urlopen(urllib.request.Request(url + path, data=body), timeout=30)
        said = refused.value.read()
        assert refused.value.headers["retry-after"] == "1"
        assert isinstance(refusal(503, refused.value.headers["content-type"], said), NoReplica)


@contextmanager
def applications(folder: Path, servers: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield the URL of a HAProxy in front of applications, of which each has a path and servers,
    as in Serve's settings.
    """
    frontend: list[str] = []
    backends = ["backend default_backend", "    http-request return status 404"]
    for path, lines in servers.items():
        name = f"http-{path.strip('/') or 'root'}"
        prefix = path if path == "/" else f"{path}/"
        frontend += [f"    acl is_{name} path_beg {prefix}", f"    acl is_{name} path {path}"]
        frontend += [f"    use_backend {name} if is_{name}"]
        backends += [f"backend {name}", *(f"    server {line}" for line in lines)]

    settings = [*frontend, "    default_backend default_backend", *backends, ""]
    with started(folder, "\n".join(settings)) as url:
        yield url


OTHER = REPLICA.replace("Policy-1", "Policy-2")
DISABLED = f"{REPLICA} disabled"


@needs_haproxy
@pytest.mark.parametrize(
    ("servers", "status"),
    [
        ({"/left": [REPLICA, FALLBACK], "/right": [REPLICA, FALLBACK]}, 200),
        ({"/left": [DISABLED, OTHER, FALLBACK], "/right": [REPLICA]}, 200),
        ({"/left": [REPLICA, FALLBACK], "/right": [FALLBACK]}, 503),
        ({"/left": [DISABLED, FALLBACK], "/right": [REPLICA, FALLBACK]}, 503),
        ({"/left": [REPLICA, FALLBACK]}, 200),
        ({}, 404),
        # The application at "/" replies itself; here nothing answers for it.
        ({"/": [FALLBACK], "/right": [REPLICA, FALLBACK]}, 503),
    ],
)
def test_the_health_of_several_applications_is_at_the_root(
    servers: Mapping[str, Sequence[str]], status: int, tmp_path: Path
) -> None:
    with applications(tmp_path, servers) as url:
        answer = answer_to(url, "GET /healthz HTTP/1.1\r\nhost: a\r\n\r\n")
        assert answer.startswith(f"HTTP/1.1 {status} ".encode())


@needs_haproxy
@pytest.mark.parametrize(("servers", "headers"), [([REPLICA, FALLBACK], {}), ([FALLBACK], UPGRADE)])
def test_a_replica_may_take_its_time_and_a_websocket_waits_for_one(
    servers: list[str], headers: dict[str, str], tmp_path: Path
) -> None:
    with proxied(tmp_path, *servers) as url:
        connection = HTTPConnection(url.removeprefix("http://"), timeout=4)
        connection.request("GET", "/v1/act", headers=headers)
        with pytest.raises(TimeoutError):
            connection.getresponse()
        connection.close()


def test_a_frozen_replica_is_out_of_the_way_when_its_clients_leave_it() -> None:
    """Otherwise the hash would send some clients back to the frozen replica, until their next calls
    had also failed.
    """
    between = max(
        seconds(RAY_SERVE_HAPROXY_HEALTH_CHECK_FASTINTER),
        seconds(RAY_SERVE_HAPROXY_HEALTH_CHECK_DOWNINTER),
    )
    every, failures = seconds(ROBOTS[_CHECK_INTERVAL]), int(ROBOTS[_CHECK_FAILURES])
    left_s = every + every + (failures - 1) * (between + every)
    # Clients ping after half a second, and leave when a ping is not answered for `FROZEN_S`.
    assert left_s <= 0.5 + FROZEN_S


@needs_haproxy
def test_a_replica_that_does_not_answer_gets_no_more_requests(tmp_path: Path) -> None:
    class Healthy(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Suppress the log."""

    def answered(url: str) -> bool:
        try:
            for number in range(10):
                request = urllib.request.Request(
                    f"{url}/v1/act", headers={"x-session-id": f"session-{number}"}
                )
                urllib.request.urlopen(request, timeout=3).close()
        except OSError:
            return False
        return True

    checked = f"check inter {ROBOTS[_CHECK_INTERVAL]} fall {ROBOTS[_CHECK_FAILURES]}"
    with ThreadingHTTPServer(("127.0.0.1", 0), Healthy) as server:
        threading.Thread(target=server.serve_forever).start()
        alive = f"SERVE_REPLICA_app-Policy-2 127.0.0.1:{server.server_port} {checked}"
        balance = ROBOTS["RAY_SERVE_HAPROXY_BALANCE_ALGORITHM"]
        settings = f"    balance {balance}    option httpchk GET /-/healthz\n"
        try:
            with proxied(tmp_path, f"{REPLICA} {checked}", alive, settings=settings) as url:
                assert not answered(url)
                wait_for(lambda: answered(url), 60)
        finally:
            server.shutdown()


@contextmanager
def toggled(name: str) -> Iterator[tuple[int, threading.Event]]:
    """Run a server that answers with its name while the event is set, and yield its port and the
    event.
    """
    up, over = threading.Event(), threading.Event()

    class Named(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            while not up.is_set() and not over.is_set():
                up.wait(0.1)
            with suppress(OSError):  # the client may have left in the meantime
                self.send_response(200)
                self.send_header("content-length", str(len(name)))
                self.end_headers()
                self.wfile.write(name.encode())

        def log_message(self, *_: Any) -> None:
            """Suppress the log."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Named) as server:
        threading.Thread(target=server.serve_forever).start()
        try:
            yield server.server_port, up
        finally:
            over.set()
            server.shutdown()


def server_of(url: str, session: str) -> str:
    """Return the name of the server that answers the session; "" if none does."""
    with suppress(OSError):
        request = urllib.request.Request(f"{url}/v1/act", headers={"x-session-id": session})
        with urllib.request.urlopen(request, timeout=1) as answer:
            return str(answer.read().decode())
    return ""


def answer_to(url: str, request: str, address: str = "127.0.0.1") -> bytes:
    """Return the answer to a request as text; the request comes from `address` of this machine."""
    port = int(url.rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port), 10, (address, 0)) as client:
        client.sendall(request.encode())
        return client.recv(65536)


@contextmanager
def upgrading() -> Iterator[tuple[str, list[dict[str, str]]]]:
    """Yield a replica's line in HAProxy's settings, and the headers of the requests that reach the
    replica.
    """
    headers: list[dict[str, str]] = []

    class Upgrade(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            headers.append({name.lower(): value for name, value in self.headers.items()})
            self.send_response(101)
            self.send_header("connection", "upgrade")
            self.send_header("upgrade", "websocket")
            # The answer to the key in UPGRADE.
            self.send_header("sec-websocket-accept", "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=")
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Suppress the log."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Upgrade) as server:
        threading.Thread(target=server.serve_forever).start()
        try:
            yield f"SERVE_REPLICA_app-Policy-1 127.0.0.1:{server.server_port}", headers
        finally:
            server.shutdown()


@needs_haproxy
def test_the_list_of_applications_is_hidden_in_each_encoding_of_its_path(tmp_path: Path) -> None:
    plain = "/-/routes"
    encoded = [f"{plain[:at]}%{ord(plain[at]):02x}{plain[at + 1 :]}" for at in range(1, len(plain))]
    all_encoded = "/" + "".join(f"%{ord(character):02X}" for character in plain[1:])
    with upgrading() as (replica, reached), proxied(tmp_path, replica) as url:
        for path in [
            plain,
            "/-/ROUTES",
            "/-/routes?x=1",
            all_encoded,
            *encoded,
            *map(str.upper, encoded),
        ]:
            answer = answer_to(url, f"GET {path} HTTP/1.1\r\nhost: localhost\r\n\r\n")
            assert answer.startswith(b"HTTP/1.1 404"), path
        assert not reached


HANDSHAKE = "GET /v1/stream HTTP/1.1\r\nhost: localhost\r\n" + "".join(
    f"{name}: {value}\r\n" for name, value in UPGRADE.items()
)


@needs_haproxy
def test_no_replica_is_offered_compression(tmp_path: Path) -> None:
    offer = "Sec-WebSocket-Extensions: permessage-deflate; client_max_window_bits\r\n"
    with upgrading() as (replica, reached), proxied(tmp_path, replica) as url:
        assert answer_to(url, HANDSHAKE + offer + offer + "\r\n").startswith(b"HTTP/1.1 101")
        assert "sec-websocket-extensions" not in reached[0]


@needs_haproxy
@pytest.mark.parametrize(
    "more", ["Content-Length: 5\r\n\r\nhello", "Transfer-Encoding: chunked\r\n\r\n"]
)
def test_a_handshake_with_a_body_is_refused_at_once(more: str, tmp_path: Path) -> None:
    """A replica would never answer such a handshake."""
    with upgrading() as (replica, reached), proxied(tmp_path, replica) as url:
        assert answer_to(url, HANDSHAKE + more).startswith(b"HTTP/1.1 400")
        assert not reached


@needs_haproxy
def test_one_address_does_not_take_all_connections(tmp_path: Path) -> None:
    with upgrading() as (replica, _), proxied(tmp_path, replica) as url, ExitStack() as held:
        port = int(url.rpartition(":")[2])
        for _number in range(MOST_CONNECTIONS):
            # HAProxy closes connections over the limit, some of them before `connect` returns.
            with suppress(OSError):
                client = held.enter_context(
                    socket.create_connection(("127.0.0.1", port), 10, ("127.0.0.2", 0))
                )
                client.sendall(b"GET /healthz HTTP/1.1\r\n")
        assert answer_to(url, HANDSHAKE + "\r\n").startswith(b"HTTP/1.1 101")
        held.close()

        def is_let_in_again() -> bool:
            with suppress(OSError):
                return answer_to(url, HANDSHAKE + "\r\n", "127.0.0.2").startswith(b"HTTP/1.1 101")
            return False

        wait_for(is_let_in_again, 30)


@needs_haproxy
@pytest.mark.parametrize("other", ["replica", "fallback"])
def test_a_session_returns_from_serves_own_proxy_but_not_from_a_replica_where_it_acts(
    other: str, tmp_path: Path
) -> None:
    """Otherwise a replica that thaws would take sessions from the replica where they act."""
    sessions = [f"session-{number}" for number in range(10)]
    checked = "check inter 100ms fall 2 rise 2"
    with toggled("thawing") as (first, up), toggled(other) as (second, also_up):
        also_up.set()
        servers = [f"SERVE_REPLICA_app-Policy-1 127.0.0.1:{first} {checked}"]
        if other == "replica":
            servers.append(f"SERVE_REPLICA_app-Policy-2 127.0.0.1:{second} {checked}")
        else:
            servers.append(f"SERVE_PROXY_ACTOR-fallback 127.0.0.1:{second} {checked} backup")
        balance = ROBOTS["RAY_SERVE_HAPROXY_BALANCE_ALGORITHM"]
        settings = (
            f"    balance {balance}    option httpchk GET /-/healthz\n    option abortonclose\n"
        )
        with proxied(tmp_path, *servers, settings=settings) as url:
            wait_for(lambda: {server_of(url, one) for one in sessions} == {other}, 30)
            up.set()
            names = (f"new-{number}" for number in itertools.count())
            wait_for(lambda: server_of(url, next(names)) == "thawing", 30)
            assert {server_of(url, one) for one in sessions} == {
                "thawing" if other == "fallback" else other
            }


def listens(port: int) -> bool:
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), 5):
        return True
    return False
