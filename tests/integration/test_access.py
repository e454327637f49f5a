"""API keys, encryption and sockets of a real server that other machines can reach."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import re
import socket
import ssl
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import grpc
import numpy as np
import psutil
import pytest
import ray
from certificates import Authority, authority
from eval_fakes import PYTHONPATH, wait_for
from in_process_evaluation import flat_config
from ray_processes import leaked, words
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from vlagents_ray import (
    ConfigError,
    ConnectionLost,
    Forbidden,
    Obs,
    RemoteAgent,
    Unauthorized,
    VLAgentsError,
)
from vlagents_ray.client.credentials import KEY_VARIABLE
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.evaluate import evaluate
from vlagents_ray.protocol.frames import decode_replies, encode_requests
from vlagents_ray.protocol.messages import LocalAddress, Request
from vlagents_ray.ray_tools.reaper import MARK
from vlagents_ray.serve.access.key_store import new_key, revoke
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.haproxy import Tls
from vlagents_ray.serve.launch.server import running_server

EVERYWHERE = "0.0.0.0"  # noqa: S104 - this test is about such a server
TRANSPORTS: tuple[TransportName, ...] = ("http", "websocket", "shm", "auto")


LIMITS = {
    "pixels": 64 * 64,
    "cameras": 2,
    "state_values": 8,
    "depth": 3,
    "items": 100,
    "body_bytes": 2**20,
    "text": 50,
}
TOO_MUCH = {
    "pixels": Obs(cameras={"front": np.zeros((65, 64, 3), np.uint8)}),
    "cameras": Obs(cameras={name: np.zeros((8, 8, 3), np.uint8) for name in "abc"}),
    "states": Obs(state={name: np.zeros(1, np.float32) for name in "abc"}),
    "state_values": Obs(state={"joints": np.zeros(9, np.float32)}),
    "depth": Obs(info={"a": {"b": {"c": {"d": 1}}}}),
    "items": Obs(info={"a": list(range(101))}),
    "body_bytes": Obs(info={"a": np.zeros(2**21, np.uint8)}),
}


@dataclass(frozen=True)
class Listener:
    """One socket to which other processes can send."""

    process: str
    kind: str  # "tcp", "udp", "unix"
    host: str  # an address; for Unix sockets the path, or "@" and the name
    port: int = 0

    @property
    def is_local(self) -> bool:
        """Return whether no other machine can reach the socket."""
        return self.kind == "unix" or self.host.removeprefix("::ffff:") in ("127.0.0.1", "::1")


def listeners(root: psutil.Process) -> set[Listener]:
    """Return the listening sockets of the server's driver process and of all its child
    processes.
    """
    found = set()
    for process in [root, *root.children(recursive=True)]:
        try:
            name = "driver" if process == root else name_of(process)
            sockets = process.net_connections("inet")
            unix = unix_sockets(process.pid)
        except (psutil.NoSuchProcess, OSError):  # the process has ended
            continue
        for one in sockets:
            if one.status == psutil.CONN_LISTEN or (
                one.type == socket.SOCK_DGRAM and one.laddr and not one.raddr
            ):
                kind = "tcp" if one.type == socket.SOCK_STREAM else "udp"
                found.add(Listener(name, kind, one.laddr.ip, one.laddr.port))
        found |= {Listener(name, "unix", path) for path in unix}
    return found


def name_of(process: psutil.Process) -> str:
    """Return the name of the program, whichever interpreter runs it."""
    said = words(process) or [process.name()]
    scripts = [Path(word).name for word in said if word.endswith(".py")]
    program = Path(said[0].split()[0]).name
    # The titles of Ray's workers change with their current task: "ray::Class.method".
    return (
        scripts[0]
        if scripts
        else program.partition(".")[0]
        if program.startswith("ray::")
        else program
    )


def unix_sockets(pid: int) -> set[str]:
    """Return the named Unix sockets on which a process waits for messages or connections."""
    inodes = set()
    for descriptor in Path(f"/proc/{pid}/fd").glob("*"):
        try:
            if match := re.fullmatch(r"socket:\[(\d+)\]", str(descriptor.readlink())):
                inodes.add(match[1])
        except OSError:
            continue
    found = set()
    for line in Path(f"/proc/{pid}/net/unix").read_text().splitlines()[1:]:
        _, _, _, flags, kind, _, inode, *path = line.split(maxsplit=7)
        accepts, datagram = int(flags, 16) & 0x10000, kind == "0002"
        if inode in inodes and path and (accepts or datagram):
            found.add(path[0])
    return found


@dataclass
class Served:
    url: str
    keys: Path
    tokens: dict[str, str]
    ca: Authority

    def agent(self, who: str | None, **options: object) -> RemoteAgent:
        key = self.tokens.get(who, who) if who is not None else ""
        return RemoteAgent(self.url, api_key=key, **{"ca": self.ca.file, **options})  # type: ignore[arg-type]

    @property
    def trust(self) -> ssl.SSLContext:
        return ssl.create_default_context(cafile=self.ca.file)

    @property
    def threaded_trust(self) -> ssl.SSLContext:
        """Return a TLS context for the client of `websockets`, which reads and writes in two
        threads at the same time.

        With TLS 1.3, whose tickets arrive while the request is written, Python 3.11 loses about one
        of 200 handshakes on a busy machine; with TLS 1.2 it loses none of 8,000.
        """
        trust = self.trust
        trust.maximum_version = ssl.TLSVersion.TLSv1_2
        return trust

    def status(self, path: str, headers: dict[str, str] | None = None) -> tuple[int, bytes]:
        parts = urlsplit(self.url)
        connection = http.client.HTTPSConnection(
            parts.hostname or "", parts.port, timeout=10, context=self.trust
        )
        with contextlib.closing(connection):
            connection.request("GET", path, headers=headers or {})
            answer = connection.getresponse()
            return answer.status, answer.read()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("access")
    ca = authority(folder, "ca")
    keys = folder / "keys.json"
    tokens = {name: new_key(keys, name) for name in ("arm", "leaver")} | {
        "other": new_key(keys, "other", apps=("x",))
    }
    tls = Tls(*ca.sign("server"))
    config = deployment("noop", limits=LIMITS)
    with running_server(
        config, host=EVERYWHERE, num_cpus=2, keys_file=keys, tls=tls, timeout_s=120
    ) as server:
        yield Served(server.url, keys, tokens, ca)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_key_is_let_in_over_tls(served: Served, transport: TransportName) -> None:
    assert served.url.startswith("https://")
    with served.agent("arm", transport=transport) as agent:
        agent.reset(Obs(), "x")
        assert agent.act(Obs()).action.shape == (7,)
        assert agent.transport == ("shm" if transport == "auto" else transport)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_nobody_else_is(served: Served, transport: TransportName) -> None:
    for who, error in ((None, Unauthorized), ("wrong", Unauthorized), ("other", Forbidden)):
        with pytest.raises(error), served.agent(who, transport=transport) as agent:
            agent.reset(Obs(), "x")


@pytest.mark.parametrize(
    "path", ["/docs", "/v1/metadata", "/nope", "/-/routes", "/stats", "/metrics"]
)
def test_no_path_tells_anything_without_a_key(served: Served, path: str) -> None:
    status, body = served.status(path)
    assert status == (404 if path == "/-/routes" else 401)
    assert b"noop" not in body
    assert served.status("/healthz") == (200, b"OK\n")


@pytest.mark.parametrize("transport", ["http", "websocket", "shm", "handle", "plasma"])
def test_every_endpoint_refuses_what_is_over_the_limits_and_goes_on(
    served: Served, transport: TransportName
) -> None:
    url = "serve://noop" if transport in ("handle", "plasma") else served.url
    with RemoteAgent(
        url,
        transport=transport,
        api_key=served.tokens["arm"],
        ca=served.ca.file,
        codec="raw",
        timeout_s=20,
    ) as agent:
        agent.reset(Obs(), "x")
        for limit, obs in TOO_MUCH.items():
            with pytest.raises(VLAgentsError) as refused:
                agent.act(obs)
            assert refused.value.code == "too_large", limit
        with pytest.raises(VLAgentsError) as refused:
            agent.reset(Obs(), "x" * 51)
        assert refused.value.code == "too_large"
        agent.reset(Obs(), "x")
        agent.act(Obs())


def test_whoever_is_in_the_cluster_finds_a_way_that_needs_no_key(served: Served) -> None:
    with RemoteAgent("serve://noop") as agent:
        agent.reset(Obs(), "x")
        assert agent.act(Obs()).action.shape == (7,)
        assert agent.transport == "plasma"


def test_a_key_is_nowhere_but_where_it_is_used(
    served: Served, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """An evaluation, clients of all transports, and a request for metadata have used the key
    before.
    """
    key = served.tokens["arm"]
    monkeypatch.setenv(KEY_VARIABLE, key)
    variables = {"SSL_CERT_FILE": str(served.ca.file), "PYTHONPATH": PYTHONPATH}
    config = flat_config(
        policy_url=served.url,
        envs=["eval_fakes:SevenLine"],
        episodes=1,
        out=tmp_path / "out",
        runtime_env={"env_vars": variables},
    )
    assert evaluate(config).total.episodes == 1
    for transport in TRANSPORTS:
        with served.agent("arm", transport=transport) as agent:
            agent.reset(Obs(), "x")
            agent.act(Obs())
    session = Path(ray._private.worker.global_worker.node.get_session_dir_path())
    # This log would contain the key.
    assert "SSL_CERT_FILE" in (session / "logs" / "runtime_env_agent.log").read_text()
    assert leaked(key, [session, Path(os.environ[MARK]), tmp_path]) == []
    _, metadata = served.status("/v1/metadata", {"x-api-key": key})
    assert metadata.startswith(b"{")
    assert key.encode() not in metadata


def test_a_revoked_key_is_shut_out_of_every_endpoint_within_seconds(served: Served) -> None:
    url = served.url.replace("https", "wss") + "/v1/stream"
    with contextlib.ExitStack() as stack:
        agents = {
            transport: stack.enter_context(served.agent("leaver", transport=transport))
            for transport in TRANSPORTS
        }
        for agent in agents.values():
            agent.reset(Obs(), "x")
        headers = {"x-api-key": served.tokens["leaver"]}
        idle = stack.enter_context(
            connect(url, ssl=served.threaded_trust, additional_headers=headers)
        )
        bystander = stack.enter_context(served.agent("arm"))
        bystander.reset(Obs(), "x")
        revoke(served.keys, "leaver")
        with pytest.raises(ConnectionClosed, match="revoked"):
            idle.recv(timeout=60)
        for agent in agents.values():
            with pytest.raises((Unauthorized, ConnectionLost)):
                agent.act(Obs())
            with pytest.raises(Unauthorized):
                agent.reset(Obs(), "x")
        bystander.act(Obs())


def test_the_shared_memory_endpoint_wants_a_key_before_anything_else(served: Served) -> None:
    status, body = served.status("/v1/metadata", {"x-api-key": served.tokens["arm"]})
    assert status == 200
    local = json.loads(body)["local"]
    assert local["keyed"]
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as endpoint:
        endpoint.settimeout(10)
        endpoint.connect(f"\0{local['socket']}")
        for message in (b"wrong", b"-", encode_requests([Request("reset", Obs())])):
            endpoint.send(message)
            (reply,) = decode_replies(endpoint.recv(2**17)[LocalAddress.REPLY.size :])
            assert isinstance(reply.error, Unauthorized)


def test_a_replicas_own_ports_want_a_key_too(served: Served) -> None:
    """The replica has ports for Serve's HTTP, and its own port for HTTP and WebSockets, whose path
    is in the metadata.
    """
    ports = {
        one.port
        for one in listeners(psutil.Process())
        if one.process == REPLICA and one.host == "127.0.0.1"
    }
    found = set()
    for port in ports:
        for path in ("/docs", "/v1/metadata", "/v1/stream/guess"):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
            with contextlib.closing(connection):
                connection.request("GET", path)
                found.add((port, connection.getresponse().status))
    assert sorted(status for _, status in found) == [401, 401]
    _, metadata = served.status("/v1/metadata", {"x-api-key": served.tokens["arm"]})
    stream = json.loads(metadata)["stream"]
    with (
        pytest.raises(InvalidStatus) as refused,
        connect(f"ws://127.0.0.1:{stream['port']}{stream['path']}"),
    ):
        pytest.fail("the client was accepted")
    assert refused.value.response.status_code == 401


def test_a_certificate_that_is_not_to_be_trusted_is_named_with_the_cure(
    served: Served, tmp_path: Path
) -> None:
    for ca in (None, authority(tmp_path, "stranger").file):
        with pytest.raises(ConfigError, match="ca="), served.agent("arm", ca=ca) as agent:
            agent.reset(Obs(), "x")
    with (
        pytest.raises(ConfigError, match="expected a file with the certificate of the CA"),
        served.agent("arm", ca=served.keys) as agent,
    ):
        agent.reset(Obs(), "x")


def test_an_old_way_to_encrypt_is_refused(served: Served) -> None:
    """Such ciphers lack forward secrecy, or use blocks whose padding leaks information."""
    parts = urlsplit(served.url)
    for ciphers, taken in (
        ("AES256-SHA:AES128-GCM-SHA256:ECDHE-RSA-AES128-SHA", False),
        ("ECDHE+AESGCM", True),
    ):
        trust = served.threaded_trust
        trust.set_ciphers(ciphers)
        with socket.create_connection((parts.hostname, parts.port), 10) as raw:
            if taken:
                trust.wrap_socket(raw, server_hostname="127.0.0.1").close()
            else:
                with pytest.raises((ssl.SSLError, ConnectionResetError)):
                    trust.wrap_socket(raw, server_hostname="127.0.0.1")


def test_requests_that_never_end_are_cut_off(served: Served) -> None:
    parts = urlsplit(served.url)
    with (
        socket.create_connection(("127.0.0.1", parts.port or 0), timeout=120) as raw,
        served.trust.wrap_socket(raw, server_hostname="127.0.0.1") as slow,
        served.agent("arm", transport="http") as bystander,
    ):
        slow.sendall(b"POST /v1/reset HTTP/1.1\r\nhost: x\r\n")
        bystander.reset(Obs(), "x")
        bystander.act(Obs())
        answer = slow.recv(4096)
        assert not answer or b" 408 " in answer.partition(b"\r\n")[0]


# Who may use each socket of a running server. "token": processes with the cluster's token, which is
# in a file of the user who started it; "key": clients with an API key; "user": processes of the
# user who started the server; "machine": any process of this machine, which can read numbers there
# but change nothing.
REPLICA = "ray::ServeReplica:noop:Policy"
WHO = [
    (r"haproxy", "tcp", "front", "key"),
    # Serve's own port, which requires a key, and the ports of metrics and statistics.
    (r"haproxy", "tcp", "local", "machine"),
    # HAProxy sends its log from this socket, and never reads from it
    (r"haproxy", "udp", "any", "nobody"),
    (r"haproxy", "unix", r".*/vlr-[^/]*/.*/admin.*", "user"),
    (r"ray::HAProxyManager", "unix", r".*/vlr-[^/]*/.*/metrics", "user"),
    (
        r"ray::HAProxyManager|ray::ServeController|ray::ProxyActor|ray::IDLE.*|driver",
        "tcp",
        "local",
        "token",
    ),
    (r"gcs_server|raylet", "tcp", "local", "token"),
    (r"raylet", "unix", r".*/sockets/(raylet|plasma_store)", "user"),
    (r"ray::DashboardAgent|ray::RuntimeEnvAgent|agent\.py", "tcp", "local", "token"),
    # The port of Ray's worker is also here; it requires the token.
    (REPLICA, "tcp", "local", "key"),
    (REPLICA, "tcp", "any", "token"),  # for calls between deployments, tested below
    (REPLICA, "unix", r"@vlagents-ray-[0-9a-f]{32}", "key"),
    # Sockets that claim ports. Other processes read the owner's id.
    (r"driver", "unix", r"@vlagents-ray-port-[0-9]+", "machine"),
    (REPLICA, "unix", r".*/sockets/\.?vla[0-9a-f]{8}", "user"),
]


def who(one: Listener, front: int) -> str | None:
    for process, kind, where, allowed in WHO:
        if not re.fullmatch(process, one.process) or kind != one.kind:
            continue
        if kind == "unix":
            fits = re.fullmatch(where, one.host)
        else:
            fits = {
                "front": one.port == front,
                "local": one.is_local,
                "any": not one.is_local or kind == "udp",
            }[where]
        if fits:
            return allowed
    return None


def is_private(path: Path) -> bool:
    """Return whether a parent folder keeps other users out. The folder's own mode would not
    suffice, since they could replace the folder.
    """
    return any(not stat.S_IMODE(place.stat().st_mode) & 0o077 for place in path.parents)


def test_every_socket_of_a_running_server_is_known_and_closed_to_strangers(served: Served) -> None:
    front = urlsplit(served.url).port or 0
    found: dict[Listener, str | None] = {}

    def all_known() -> bool:
        """A process gets its name, and closes its sockets, shortly after its start or end."""
        found.clear()
        found.update({one: who(one, front) for one in listeners(psutil.Process())})
        return None not in found.values()

    with contextlib.suppress(TimeoutError):
        wait_for(all_known, 60)
    assert [one for one, allowed in found.items() if allowed is None] == []
    open_to_others = {one for one in found if not one.is_local and one.kind == "tcp"}
    assert {one.process for one in open_to_others} == {"haproxy", REPLICA}
    assert [one.port for one in open_to_others if one.process == "haproxy"] == [front]
    assert len(open_to_others) == 2
    for one, allowed in found.items():
        if one.kind == "unix" and allowed == "user":
            assert is_private(Path(one.host)), one


def test_calls_between_deployments_want_the_clusters_token(served: Served) -> None:
    """This port is the only one of Ray's ports that other machines can reach, and it executes the
    calls that it receives.
    """
    (port,) = {
        one.port
        for one in listeners(psutil.Process())
        if one.process == REPLICA and not one.is_local and one.kind == "tcp"
    }
    for metadata in ((), (("authorization", "Bearer wrong"),)):
        with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
            call = channel.unary_unary("/ray.serve.ASGIService/HandleRequest")
            with pytest.raises(grpc.RpcError) as refused:
                call(b"", timeout=10, metadata=metadata)
            assert refused.value.code() == grpc.StatusCode.UNAUTHENTICATED


def test_statistics_and_metrics_are_on_loopback_alone(served: Served) -> None:
    for name in ("RAY_SERVE_HAPROXY_STATS_PORT", "RAY_SERVE_HAPROXY_METRICS_PORT"):
        port = int(os.environ[name])
        socket.create_connection(("127.0.0.1", port), timeout=5).close()
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("127.0.0.2", port), timeout=5).close()
