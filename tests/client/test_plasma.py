"""Who can use plasma, decided before anything is opened."""

from __future__ import annotations

from typing import Any

import pytest

from vlagents_ray import RemoteAgent
from vlagents_ray.client.handle import HandleTransport
from vlagents_ray.client.plasma import PlasmaTransport
from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.interface import Obs

HERE, ELSEWHERE = "a" * 56, "b" * 56


@pytest.mark.parametrize(
    ("node", "address", "said"),
    [
        (HERE, {"socket": "/nowhere", "node": ELSEWHERE}, "use transport 'handle'"),
        (HERE, None, "no plasma door"),
        (None, {"socket": "/nowhere", "node": HERE}, "use http://"),
    ],
)
def test_who_is_not_on_the_replicas_node_is_told_what_to_use(
    monkeypatch: pytest.MonkeyPatch, node: str | None, address: dict[str, Any] | None, said: str
) -> None:
    monkeypatch.setattr("vlagents_ray.client.plasma.this_node", lambda: node)
    with pytest.raises(ConfigError, match=said):
        PlasmaTransport("app").connect_to(HandleTransport("app"), {"plasma": address}, 1)


def test_a_door_that_is_gone_is_unavailable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vlagents_ray.client.plasma.this_node", lambda: HERE)
    with pytest.raises(PolicyUnavailable, match="does not answer"):
        PlasmaTransport("app").connect_to(HandleTransport("app"), {"plasma": {"socket": "/no/door", "node": HERE}}, 1)


def test_outside_of_a_cluster_there_is_no_plasma() -> None:
    with pytest.raises(ConfigError, match="in no Ray cluster"):
        RemoteAgent("serve://app", transport="plasma").reset(Obs())
    with pytest.raises(ConfigError, match="serve://APP"):
        RemoteAgent("http://localhost:8000", transport="plasma")
