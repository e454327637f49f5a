"""Each cell of the table in docs/access.md is tested on a replica with API keys and all its
endpoints.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from api_key_replica import ATTEMPTS, KeyedReplica, keyed_replica
from dialect_server import ALL

from vlagents_ray.protocol.messages import OPS
from vlagents_ray.registry import names

PAGE = Path(__file__).parents[2] / "docs" / "access.md"
CREDENTIALS = 9


@dataclass(frozen=True)
class Cell:
    endpoint: str
    when: str
    credential: str
    stated: str


def _cells() -> list[Cell]:
    _, head, table = PAGE.read_text().partition("\n| endpoint | when |")
    rows = [
        [cell.strip() for cell in line.strip("|\n ").split("|")]
        for line in (head.strip() + table).splitlines()
        if line.startswith("|")
    ]
    (_, _, *credentials), _, *lines = rows
    return [
        Cell(endpoint, when, credential, stated)
        for endpoints, moments, *all_stated in lines
        for endpoint in endpoints.split("<br>")
        for when in moments.split("<br>")
        for credential, stated in zip(credentials, all_stated, strict=True)
    ]


CELLS = _cells()


@pytest.fixture(scope="module")
def replica(tmp_path_factory: pytest.TempPathFactory) -> Iterator[KeyedReplica]:
    with keyed_replica(tmp_path_factory.mktemp("plasma")) as one:
        yield one


@pytest.mark.slow
@pytest.mark.parametrize(
    "cell", CELLS, ids=lambda cell: f"{cell.endpoint}, {cell.when}, {cell.credential}"
)
def test_what_the_table_says_is_so(replica: KeyedReplica, cell: Cell) -> None:
    visitor = replica.visitor(cell.credential)
    said = ATTEMPTS[cell.endpoint](visitor, cell.when)
    done = visitor.mark in replica.policy.done
    if cell.stated in ("acts", "as simulation"):
        assert (said in ("done", "200"), done) == (True, True), said
        assert replica.priorities[visitor.mark] == (
            "ROBOT" if cell.stated == "acts" else "SIMULATION"
        )
        return
    assert not done, said
    if cell.stated != "nothing":
        # The server may close the connection before it rejects the request.
        assert said == cell.stated or (said == "ended" and cell.when == "after" and visitor.ends)


def test_the_table_names_every_endpoint(replica: KeyedReplica) -> None:
    assert {cell.endpoint for cell in CELLS} == set(ATTEMPTS)
    assert len(CELLS) % CREDENTIALS == 0
    assert len({(cell.endpoint, cell.when, cell.credential) for cell in CELLS}) == len(CELLS) >= 300
    connected = {
        endpoint
        for endpoint in ATTEMPTS
        if endpoint.startswith("`WS") or endpoint in ("own port", "shared memory")
    }
    for endpoint in connected:
        assert {cell.when for cell in CELLS if cell.endpoint == endpoint} == {
            "before",
            "with",
            "after",
        }
    routes = {getattr(route, "path", "") for route in _routes(replica)}
    named = {
        endpoint.strip("`").partition(" ")[2] for endpoint in ATTEMPTS if endpoint.startswith("`")
    }
    new = routes - {"/openapi.json"} - named - {f"/v1/{op}" for op in OPS}
    assert not new, (
        "add new endpoints to ATTEMPTS in tests/support/api_key_replica.py and to docs/access.md"
    )
    with_ports = {"gr00t", "vlagents", "lerobot", "lerobot_remote"}
    assert set(names("dialects")) == {*ALL, *with_ports}, (
        "add a new dialect to `keyed_replica` and to ATTEMPTS"
    )


def _routes(replica: KeyedReplica) -> list[object]:
    return list(replica.routes)
