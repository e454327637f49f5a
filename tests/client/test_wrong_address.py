"""What a client says of a URL with a wrong scheme, port or host, and how soon."""

from __future__ import annotations

import contextlib
import http.server
import ssl
import threading
import time
from collections.abc import Iterator

import pytest
from certificates import authority

from vlagents_ray import RemoteAgent
from vlagents_ray.errors import ConfigError, PolicyUnavailable, VLAgentsError
from vlagents_ray.serve.ports import free_port

TIMEOUT_S = 1.0


@contextlib.contextmanager
def http_server(context: ssl.SSLContext | None = None) -> Iterator[int]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), http.server.BaseHTTPRequestHandler) as server:
        server.handle_error = lambda *_: None  # type: ignore[method-assign]
        if context is not None:
            server.socket = context.wrap_socket(server.socket, server_side=True)
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server.server_port
        server.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def ports(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, int]]:
    ours = authority(tmp_path_factory.mktemp("ca"), "ours")
    tls, mutual = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    for context in (tls, mutual):
        context.load_cert_chain(*ours.sign("server"))
    mutual.maximum_version, mutual.verify_mode = ssl.TLSVersion.TLSv1_2, ssl.CERT_REQUIRED
    with http_server() as plain, http_server(tls) as encrypted, http_server(mutual) as keyed:
        yield {"PLAIN": plain, "TLS": encrypted, "MUTUAL": keyed, "CLOSED": free_port()}


@pytest.mark.parametrize("transport", ["auto", "http", "websocket"])
@pytest.mark.parametrize(
    ("url", "kind", "said"),
    [
        ("http://127.0.0.1:{TLS}", ConfigError, "this port speaks TLS; write https://127.0.0.1:{TLS}"),
        ("http://127.0.0.1:{MUTUAL}", ConfigError, "this port speaks TLS; write https://127.0.0.1:{MUTUAL}"),
        ("https://127.0.0.1:{PLAIN}", ConfigError, "if the server has none, write http://127.0.0.1:{PLAIN}"),
        ("http://127.0.0.1:{CLOSED}", PolicyUnavailable, "is it running?"),
        ("https://127.0.0.1:{CLOSED}", PolicyUnavailable, "is it running?"),
        ("http://nowhere.invalid:80", PolicyUnavailable, "nowhere.invalid:80: cannot connect"),
    ],
)
def test_a_wrong_address_is_named_within_the_time_of_a_call(
    ports: dict[str, int], transport: str, url: str, kind: type[VLAgentsError], said: str
) -> None:
    url, said = url.format(**ports), said.format(**ports)
    begun = time.monotonic()
    with pytest.raises(kind) as caught:
        RemoteAgent(url, transport=transport, timeout_s=TIMEOUT_S).initialize()  # type: ignore[arg-type]
    assert said in str(caught.value)
    assert time.monotonic() - begun < TIMEOUT_S + 5
