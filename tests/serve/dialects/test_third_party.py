"""A third-party dialect: the example in `vlagents_ray/serve/dialects/base.py`, installed from
outside of this package.
"""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest
from dialect_server import METADATA, serving
from served_agents import Witness

from vlagents_ray.errors import ConfigError, MissingDependency
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.dialects import base
from vlagents_ray.serve.endpoints.docs_page import docs_page
from vlagents_ray.serve.launch.deployment_file import deployment

PACKAGE = "third_party_dialect"
CLASS = f"{PACKAGE}:PlainDialect"


@pytest.fixture(name="package")
def installed_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write the example as an importable module, and return its folder."""
    _, _, rest = base.__doc__.partition("::\n\n")
    (tmp_path / f"{PACKAGE}.py").write_text(textwrap.dedent(rest.partition("\n`tests/")[0]))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, PACKAGE, raising=False)
    return tmp_path


@pytest.fixture(name="plain")
def entry_point(package: Path) -> str:
    """Return the name under which a distribution registers the example."""
    info = package / f"{PACKAGE}-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {PACKAGE}\nVersion: 1\n")
    (package / f"{PACKAGE}_registry.py").write_text(
        f"from vlagents_ray.registry import RegistryEntry\nPLAIN = RegistryEntry({CLASS!r})\n"
    )
    (info / "entry_points.txt").write_text(
        f"[vlagents_ray.dialects]\nplain = {PACKAGE}_registry:PLAIN\n"
    )
    return "plain"


def acted(dialects: dict[str, Any]) -> list[float]:
    with serving(Witness(), dialects) as (client, _):
        answer = client.post("/plain", json={"q": [0.5, 0.25], "task": "task 3"})
        assert answer.status_code == 200, answer.text
        refused = client.post("/plain", json={"joints": [0.5]})
        assert (refused.status_code, refused.json()["code"]) == (422, "missing_state")
        assert client.post("/plain", json=[0.5]).json()["code"] == "malformed"
        row: list[float] = answer.json()
        return row


def test_a_dialect_registers_itself_by_an_entry_point(plain: str) -> None:
    row = acted({plain: {}})
    assert row[1] == 0.5
    assert row[3:] == [len("task 3"), 1]
    told = DialectArgs(**{plain: {}}).describe()[plain]
    assert told["paths"] == ["POST /plain"]
    assert "Clients of the example" in docs_page(METADATA | {"dialects": {plain: told}})


def test_a_deployment_file_may_name_the_class_of_a_dialect(package: Path) -> None:
    assert acted({CLASS: {}, "vla_eval": {}})[1] == 0.5


def test_its_settings_are_checked_like_those_of_ours(plain: str) -> None:
    for settings, said in (
        ({plain: {"mappin": {}}}, r"dialects.plain.mappin: .*did you mean 'mapping'"),
        (
            {plain: {"mapping": {"preset": "gr01t"}}},
            r"dialects.plain.mapping: .*did you mean 'gr00t'",
        ),
        ({"plane": {}}, "expected one of .*'plain'.*, got 'plane', which is not registered"),
        (
            {"served_agents:Mirror": {}},
            "expected a subclass .*, got .*served_agents.Mirror without one",
        ),
    ):
        with pytest.raises(ConfigError, match=said):
            deployment("noop", dialects=settings)


def test_the_package_that_a_dialect_requires_is_asked_for_before_anything_starts(
    plain: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    args = DialectArgs(**{plain: {}})
    args.require_packages()
    monkeypatch.setattr(f"{PACKAGE}.PlainDialect.requires", ("no_such_package",))
    with pytest.raises(MissingDependency, match="no_such_package"):
        args.require_packages()
