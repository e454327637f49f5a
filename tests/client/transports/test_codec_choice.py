"""The codec of camera images depends on the location of the server, not on the link's
current load.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from asgi_server import policy_server

from benchmarks.photographs import photograph
from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.transports.base import CodecChoice, CodecName
from vlagents_ray.images.codecs import JPEG, LOSSLESS, RAW, ImageCodec
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.messages import LocalAddress, boot_id

OBS = Obs({"front": photograph(seed=1), "wrist": photograph(seed=2)})
SIZE = sum(image.nbytes for image in OBS.cameras.values())
SERVER = Path(__file__).parents[2] / "support/noop_http_server.py"


@contextmanager
def another_network() -> Iterator[str]:
    """Yield the URL of a server in another network namespace, at the other end of a pair of
    links.
    """
    if os.geteuid() != 0 or not shutil.which("ip"):
        pytest.skip("a network namespace needs root and ip (Debian: iproute2)")

    def ip(*words: str) -> None:
        subprocess.run(["ip", *words], check=True, capture_output=True, text=True, timeout=20)

    number = os.getpid() % 2**14
    space, ours, theirs = f"vlr{number}", f"vlrh{number}", f"vlrn{number}"
    # Addresses that RFC 2544 reserves for tests of links.
    host, peer = (f"198.18.{number // 64}.{number % 64 * 4 + end}" for end in (1, 2))
    inside = ["netns", "exec", space]
    with ExitStack() as stack:
        ip("netns", "add", space)
        stack.callback(ip, "netns", "del", space)
        ip("link", "add", ours, "type", "veth", "peer", "name", theirs, "netns", space)
        for where, link, address in (([], ours, host), ([*inside, "ip"], theirs, peer)):
            ip(*where, "address", "add", f"{address}/30", "dev", link)
            ip(*where, "link", "set", link, "up")
        command = ["ip", *inside, sys.executable, str(SERVER), peer]
        process = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        stack.callback(process.terminate)
        assert process.stdout is not None
        yield f"http://{peer}:{process.stdout.readline().strip()}"


@pytest.mark.parametrize(("requested", "compressed"), [("auto", JPEG), ("exact", LOSSLESS)])
def test_pixels_are_raw_within_a_machine_and_compressed_over_a_network(
    requested: CodecName, compressed: ImageCodec
) -> None:
    choice = CodecChoice(requested)
    assert choice.codec is None
    # Each connection chooses again.
    for near, chosen in ((True, RAW), (False, compressed), (True, RAW)):
        choice.connected(near=near)
        assert choice.codec == choice.codec_for(OBS) == chosen
    assert choice.codec_for(OBS, most_bytes=SIZE) == RAW
    assert choice.codec_for(OBS, most_bytes=SIZE - 1) == compressed
    assert choice.codec_for(Obs(state={"joints": np.zeros(7)}), most_bytes=1) == RAW


@pytest.mark.parametrize("named", ["raw", "lossless", "jpeg", ImageCodec("jpeg", 50, "420")])
def test_a_named_codec_is_taken_wherever_the_server_is(named: CodecName | ImageCodec) -> None:
    choice = CodecChoice(named)
    codec = named if isinstance(named, ImageCodec) else ImageCodec(named)
    for near in (True, False):
        choice.connected(near=near)
        assert choice.codec_for(OBS, most_bytes=1) == codec


def test_loopback_gets_raw_pixels() -> None:
    with policy_server(Noop(), local=asdict(LocalAddress(socket="", boot_id=boot_id()))) as port:
        for transport in ("websocket", "http"):
            with RemoteAgent(f"http://127.0.0.1:{port}", transport=transport) as agent:  # type: ignore[arg-type]
                assert agent.codec is None
                agent.reset(OBS, "look")
                assert agent.codec == RAW
                agent.act(OBS)


def test_a_server_in_another_network_gets_compressed_images() -> None:
    with another_network() as url:
        for transport, codec, chosen in (("websocket", "auto", JPEG), ("http", "exact", LOSSLESS)):
            with RemoteAgent(url, transport=transport, codec=codec) as agent:  # type: ignore[arg-type]
                agent.reset(OBS, "look")
                assert agent.codec == chosen
