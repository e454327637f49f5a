"""Servers at the other end of a real link: loopback, or a pair of network namespaces with a bandwidth limit."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path

import pytest

SERVER = Path(__file__).with_name("noop_http_server.py")
_numbers = count()


@contextmanager
def loopback() -> Iterator[str]:
    """The URL of a server on this machine's loopback interface."""
    with _server("127.0.0.1", []) as url:
        yield url


@contextmanager
def shaped(rate: str) -> Iterator[str]:
    """The URL of a server behind a link of `rate`, e.g. "1gbit", in either direction."""
    if os.geteuid() != 0 or not shutil.which("tc") or not shutil.which("ip"):
        pytest.skip("a shaped link needs root, ip and tc (Debian: iproute2)")
    number = (os.getpid() * 16 + next(_numbers)) % 2**14
    space, ours, theirs = f"vlr{number}", f"vlrh{number}", f"vlrn{number}"
    subnet = f"198.18.{number // 64}.{number % 64 * 4 + 1}"  # RFC 2544's, for tests of links
    peer = f"198.18.{number // 64}.{number % 64 * 4 + 2}"
    inside = ["ip", "netns", "exec", space]
    limit = ["root", "tbf", "rate", rate, "burst", "64kb", "latency", "50ms"]
    with ExitStack() as stack:
        _do("ip", "netns", "add", space)
        stack.callback(_do, "ip", "netns", "del", space)
        _do("ip", "link", "add", ours, "type", "veth", "peer", "name", theirs, "netns", space)
        for where, link, address in (([], ours, subnet), (inside, theirs, peer)):
            _do(*where, "ip", "address", "add", f"{address}/30", "dev", link)
            _do(*where, "ip", "link", "set", link, "up")
            _do(*where, "tc", "qdisc", "add", "dev", link, *limit)
        yield stack.enter_context(_server(peer, inside))


@contextmanager
def _server(host: str, prefix: list[str]) -> Iterator[str]:
    command = [*prefix, sys.executable, str(SERVER), host]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield f"http://{host}:{process.stdout.readline().strip()}"
        finally:
            process.terminate()
            process.wait(60)


def _do(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True, timeout=20)
