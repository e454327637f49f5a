"""The client's errors for a URL with a wrong scheme, port or host, and the time until they are
raised.
"""

from __future__ import annotations

import ssl
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from certificates import authority
from plain_servers import http_server

from vlagents_ray import RemoteAgent
from vlagents_ray.errors import ConfigError, PolicyUnavailable, VLAgentsError
from vlagents_ray.serve.ports import free_port

TIMEOUT_S = 1.0


@pytest.fixture(scope="module")
def ports(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, int]]:
    ours = authority(tmp_path_factory.mktemp("ca"), "ours")
    tls, mutual = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    for context in (tls, mutual):
        context.load_cert_chain(*ours.sign("server"))
    mutual.maximum_version, mutual.verify_mode = ssl.TLSVersion.TLSv1_2, ssl.CERT_REQUIRED
    with http_server() as plain, http_server(tls) as encrypted, http_server(mutual) as keyed:
        yield {"PLAIN": plain, "TLS": encrypted, "MUTUAL": keyed, "CLOSED": free_port()}


@pytest.mark.slow
@pytest.mark.parametrize("transport", ["auto", "http", "websocket"])
@pytest.mark.parametrize(
    ("url", "kind", "said"),
    [
        (
            "http://127.0.0.1:{TLS}",
            ConfigError,
            "this port expects TLS; write https://127.0.0.1:{TLS}",
        ),
        (
            "http://127.0.0.1:{MUTUAL}",
            ConfigError,
            "this port expects TLS; write https://127.0.0.1:{MUTUAL}",
        ),
        (
            "https://127.0.0.1:{PLAIN}",
            ConfigError,
            "if the server has none, write http://127.0.0.1:{PLAIN}",
        ),
        ("http://127.0.0.1:{CLOSED}", PolicyUnavailable, "is it running?"),
        ("https://127.0.0.1:{CLOSED}", PolicyUnavailable, "is it running?"),
        ("http://nowhere.invalid:80", PolicyUnavailable, "nowhere.invalid:80: "),
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


@pytest.mark.parametrize("transport", ["auto", "shm", "http", "websocket"])
@pytest.mark.parametrize(
    "url",
    [
        "http://localhost:80x",
        "http://localhost:99999",
        "ws://localhost:-1",
        "http://localhost:0",
        "http://[::1",
        "http://",
        "localhost:8000",
        "ftp://localhost:1",
        "",
    ],
)
def test_what_is_no_address_is_refused_before_anything_is_tried(url: str, transport: str) -> None:
    with pytest.raises(ConfigError, match=r"url: expected http\(s\)://HOST:PORT") as caught:
        RemoteAgent(url, transport=transport).initialize()  # type: ignore[arg-type]
    assert repr(url) in str(caught.value)


@pytest.mark.parametrize("host", ["127.0.0.2", "localhost"])
def test_a_name_that_the_certificate_does_not_have_is_named_with_the_cure(
    tmp_path: Path, host: str
) -> None:
    ours = authority(tmp_path, "ours")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*ours.sign("server"))
    with http_server(context, "0.0.0.0") as port:  # noqa: S104 - for 127.0.0.2
        agent = RemoteAgent(f"https://{host}:{port}", ca=ours.file, timeout_s=TIMEOUT_S)
        with pytest.raises(ConfigError, match="write the URL with a host name of the certificate"):
            agent.initialize()
