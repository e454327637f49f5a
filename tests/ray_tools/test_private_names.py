"""The adapter to Ray lists the private names that it uses, and reports those that a Ray version
lacks.
"""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
import ray
import ray_names
import tomllib
from packaging.requirements import Requirement

from vlagents_ray.errors import ConfigError
from vlagents_ray.ray_tools import private

pytestmark = pytest.mark.ray

STATED = {name for use in private.USES for name in use.names}
PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]


def test_private_names_that_are_used_are_stated() -> None:
    names = ray_names.used(ray_names.ADAPTER)
    assert names
    assert names - STATED == set()


def test_ray_has_the_private_names_that_are_stated(caplog: pytest.LogCaptureFixture) -> None:
    assert {name for name in STATED if private.first_missing(name) is not None} == set()
    private.check_ray()
    assert caplog.text == ""


def test_a_name_that_is_gone_is_noticed() -> None:
    missing = private.first_missing
    assert missing("ray._private.worker.no_such_name.more") == "ray._private.worker.no_such_name"
    assert missing("ray._private.no_such_module.name") == "ray._private.no_such_module"
    assert missing("ray.serve._private.common.RequestMetadata.no_such_field") is not None


def test_a_ray_without_a_required_name_starts_no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("ray._private.parameter.RayParams")
    monkeypatch.setattr(ray, "__version__", "2.75.0")
    with pytest.raises(ConfigError) as raised:
        private.check_ray()
    assert str(raised.value) == (
        "Ray 2.75.0 lacks private names that this package uses: without "
        "ray._private.parameter.RayParams: Ray cannot be started on this machine; install a "
        f"version that was tried: pip install '{private.requirement()}'"
    )


def test_a_ray_without_another_name_starts_a_server_that_says_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delattr("ray._raylet.Pickle5Writer")
    monkeypatch.setattr(ray, "__version__", "2.75.0")
    private.check_ray()
    [record] = caplog.records
    assert record.levelno == logging.WARNING
    assert (
        "without ray._raylet.Pickle5Writer: processes on the node of a replica use the slower Serve "
        "handle in place of plasma"
    ) in record.getMessage()
    assert not private.has_channels()


@pytest.mark.parametrize("version", ["2.55.1", "2.75.0", "3.0.0", "none"])
def test_a_ray_that_was_not_tried_is_named(
    version: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(ray, "__version__", version)
    private.check_ray()
    assert f"Ray {version} has all private names that this package uses, but was not tried" in (
        caplog.text
    )
    assert private.requirement() in caplog.text


def test_the_versions_that_are_installed_are_those_that_were_tried() -> None:
    [required] = [
        Requirement(text)
        for text in PROJECT["optional-dependencies"]["serve"]
        if text.startswith("ray[")
    ]
    assert required == Requirement(private.requirement())


def test_a_replica_of_another_serve_says_why_it_cannot_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def ends() -> bool:
        raise AttributeError("'Replica' object has no attribute '_shutting_down'")

    monkeypatch.setattr(private, "replica_is_ending", ends)
    with pytest.raises(
        ConfigError, match="no attribute '_shutting_down': a replica that is stopped"
    ):
        private.check_replica()
