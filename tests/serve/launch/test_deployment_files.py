"""Deployment files, and servers with impossible settings: errors are found before anything
starts.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from certificates import authority

from vlagents_ray import ConfigError
from vlagents_ray.registry import requirements_file
from vlagents_ray.serve.launch.deployment_file import (
    deployment,
    own_settings,
    read_deployment,
    together,
    with_user_config,
)
from vlagents_ray.serve.launch.haproxy import Tls
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray.serve.ports import EVERYWHERE

ROOT = Path(__file__).parents[3]
STORED = "served_agents:Stored"
STEPPED = {"checkpoint": "/runs/{step}", "checkpoint_step": 1}


def application(args: str) -> str:
    return f"applications: [{{name: a, import_path: vlagents_ray.serve.app:build, args: {args}}}]"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (application("{policy: noop, polic: 1}"), "polic"),
        (application("{policy: nope}"), "nope"),
        (application("{}"), "policy"),
        (application("{policy: noop, config: {xy: 1}}"), "xy"),
        (application("{policy: noop, batch: {max_size: 0}}"), "max_size"),
        (
            application("{policy: noop, dialects: {vlagents: {}, gr00t: {port: 8080}}}"),
            "expected a port for each dialect, got 8080",
        ),
        (application("{policy: noop, dialects: {gr00t: {mapping: gr01t}}}"), "gr01t"),
        (
            application("{policy: noop, replicas: 1, autoscaling: {}}"),
            "expected replicas or autoscaling, got both",
        ),
        ("applications: 3", "applications"),
        (application("{policy: noop}") + "\nproxy_location: Nowhere", "proxy_location"),
        (application("{policy: noop}") + "\nlogging_config: {log_level: 3}", "log_level"),
        (
            application("{policy: noop}").replace("name: a", "name: a, route_prefix: b"),
            "route_prefix",
        ),
        ("a: [", "YAML"),
    ],
)
def test_a_wrong_deployment_file_is_refused(tmp_path: Path, text: str, word: str) -> None:
    file = tmp_path / "d.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=word):
        read_deployment(str(file))


def test_a_file_says_where_to_listen_and_nobody_is_let_in_by_default(tmp_path: Path) -> None:
    file = tmp_path / "d.yaml"
    file.write_text(application("{policy: noop}"))
    http = read_deployment(str(file)).http_options
    assert (http.host, http.port) == ("127.0.0.1", 8000)
    file.write_text(
        application("{policy: noop}") + f"\nhttp_options: {{host: {EVERYWHERE}, port: 8123}}"
    )
    http = read_deployment(str(file)).http_options
    assert (http.host, http.port) == (EVERYWHERE, 8123)


@pytest.mark.slow
@pytest.mark.parametrize(
    "file",
    [*sorted((ROOT / "deployments").glob("*.yaml")), ROOT / "examples" / "raptor" / "raptor.yaml"],
    ids=lambda file: file.stem,
)
def test_every_shipped_deployment_file_is_valid(file: Path, tmp_path: Path) -> None:
    """The file is checked with this environment in place of the policy's own, since heavy modules
    are imported only when a policy loads.
    """
    text = file.read_text()
    [app] = yaml.safe_load(text)["applications"]
    if (own := app["args"].get("environment", {}).get("python")) is not None:
        assert requirements_file(Path(own).parents[1].name.removeprefix(".venv-")).is_file()
        text = text.replace(own, sys.executable)
    here = tmp_path / file.name
    here.write_text(text)
    assert read_deployment(str(here)).applications


def test_a_user_config_is_set_for_one_application_and_checked() -> None:
    both = together({name: deployment(STORED, config=STEPPED) for name in ("a", "b")})
    changed = with_user_config(both, "b", {"checkpoint_step": 2})
    assert [own_settings(app)["checkpoint_step"] for app in changed.applications] == [1, 2]
    again = with_user_config(changed, "b", {"scale": 3.0})
    assert [own_settings(app) for app in again.applications] == [
        STEPPED,
        STEPPED | {"checkpoint_step": 2, "scale": 3.0},
    ]
    with pytest.raises(ConfigError, match="scales"):
        with_user_config(both, "b", {"scales": 3.0})


def test_nothing_starts_without_keys_off_loopback_or_certificates_or_on_ipv6(
    tmp_path: Path,
) -> None:
    certificate, key = authority(tmp_path, "a").sign("server")
    other = authority(tmp_path, "b").sign("server")[1]
    wrong: list[tuple[str, dict[str, Any]]] = [
        ("--insecure", {"host": EVERYWHERE}),
        ("keys create", {"host": EVERYWHERE, "keys_file": tmp_path / "none.json"}),
        ("expected an IPv4 address, got ::1", {"host": "::1", "insecure": True}),
        ("TLS", {"tls": Tls(certificate, other)}),
        ("TLS", {"tls": Tls(tmp_path / "none", key)}),
        ("TLS", {"tls": Tls(certificate, key, client_ca=key)}),
    ]
    for said, options in wrong:
        with pytest.raises(ConfigError, match=said), running_server(deployment("noop"), **options):
            pytest.fail("started")
