"""The requests that a server without keys rejects because they come from a page of another site."""

from __future__ import annotations

import pytest

from vlagents_ray.errors import Forbidden
from vlagents_ray.serve.access import origin_check
from vlagents_ray.serve.access.origin_check import require_own_page

OURS = (
    "127.0.0.1:8000",
    "127.0.0.1",
    "[::1]:8000",
    "192.168.1.5:8000",
    "localhost:8000",
    "LocalHost",
    "robot-box:8000",
    "policy-serve-svc:8000",
    "policy.default.svc",
    "policy.default.svc.cluster.local:8000",
    "gpu.local",
    "a.internal.",
)
OTHERS = (
    "evil.example:8000",
    "evil.example",
    "127.0.0.1.evil.example",
    "127.0.0.1.nip.io:8000",
    "localhost.evil.example",
    "a.localevil.example",
    "evil.example@127.0.0.1.evil.example",
    "[::1",
    "evil.example.",
    "a" * 300,  # no host name is that long; the result of each lookup is cached
)


@pytest.mark.parametrize("host", OURS)
def test_addresses_and_names_that_nobody_else_can_have_are_ours(host: str) -> None:
    require_own_page({"host": host})


@pytest.mark.parametrize("host", OTHERS)
def test_a_name_in_the_public_dns_may_be_another_sites(host: str) -> None:
    with pytest.raises(Forbidden, match="hosts"):
        require_own_page({"host": host})


def test_whoever_runs_the_server_says_which_of_them_are_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    require_own_page({"host": "policy.example.org:8000"}, ["policy.example.org"])
    with pytest.raises(Forbidden):
        require_own_page({"host": "policy.example.org"}, ["example.org"])
    monkeypatch.setattr(origin_check, "_machine_name", lambda: "gpu1.lab.example.org")
    require_own_page({"host": "GPU1.lab.example.org:8000"})


def test_a_page_is_ours_at_its_address_alone() -> None:
    require_own_page({"host": "127.0.0.1:8000", "origin": "http://127.0.0.1:8000"})
    require_own_page({})  # a client that is not a browser
    for page in ("https://evil.example", "null", "http://[", "http://127.0.0.1:9000"):
        with pytest.raises(Forbidden, match="origin"):
            require_own_page({"host": "127.0.0.1:8000", "origin": page})
    # An origin with a host name is rejected, even if the operator has configured the name.
    with pytest.raises(Forbidden):
        require_own_page({"host": "a.example", "origin": "http://a.example"}, ["a.example"])
