"""`vlagents-ray serve`: serves a policy, and prints the addresses for clients and browsers."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vlagents_ray.cli.console import errors, out
from vlagents_ray.cli.listing import require_packages
from vlagents_ray.cli.options import (
    Address,
    ConfigDir,
    ServeSet,
    Set,
    command_of,
    find_policy,
    policy_overrides,
)
from vlagents_ray.cli.ray_session import RESTART, exit_if_ray_is_lost, quiet_ray
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.ports import EVERYWHERE, LOOPBACK

if TYPE_CHECKING:
    from vlagents_ray.serve.launch.deployment_file import Deployment
    from vlagents_ray.serve.launch.haproxy import Tls


@dataclass(frozen=True)
class ServeOptions:
    """The options of `vlagents-ray serve`."""

    source: Annotated[
        str,
        typer.Argument(
            metavar="POLICY",
            help="A registered policy, 'module:Class', or a deployment file (.yaml).",
        ),
    ]
    host: Annotated[
        str | None,
        typer.Option(
            metavar="HOST",
            help="Address on which the server listens, such as 0.0.0.0; default: the file's, or "
            "127.0.0.1.",
        ),
    ] = None
    port: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=65535,
            metavar="PORT",
            help="Port on which the server listens; default: the file's, or 8000.",
        ),
    ] = None
    settings: Set = field(default_factory=list)
    serve_set: ServeSet = field(default_factory=list)
    config_dir: ConfigDir = None
    vlagents_port: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=65535,
            metavar="PORT",
            help="A further port, which accepts clients of the package vlagents.",
        ),
    ] = None
    address: Address = None
    keys: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File of the API keys; default: the variable VLAGENTS_RAY_KEYS_FILE or "
            "VLAGENTS_RAY_KEYS.",
        ),
    ] = None
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Accept every client, without keys.")
    ] = False
    plain_http: Annotated[
        bool, typer.Option("--plain-http", help="Do not warn that keys are sent unencrypted.")
    ] = False
    tls_cert: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Certificate in PEM, with which https:// and wss:// are served."
        ),
    ] = None
    tls_key: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Private key of the certificate, in PEM.")
    ] = None
    tls_client_ca: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="CA in PEM; only clients with a certificate that it has signed are accepted.",
        ),
    ] = None

    def deployment(self) -> Deployment:
        """Return the deployment that the options describe.

        Raises:
            ConfigError: An option cannot be parsed, or a setting is wrong.
        """
        from vlagents_ray.serve.launch.deployment_file import read_deployment

        overrides = policy_overrides(self.settings, self.serve_set)
        return read_deployment(find_policy(self.source, self.config_dir), overrides=overrides)

    def tls(self) -> Tls | None:
        """Return the certificates that the options name; None if no option names a certificate.

        Raises:
            ConfigError: The certificate or its key is missing.
        """
        from vlagents_ray.serve.launch.haproxy import Tls

        if self.tls_cert is None and self.tls_key is None and self.tls_client_ca is None:
            return None
        if self.tls_cert is None or self.tls_key is None:
            raise ConfigError("TLS: expected both --tls-cert and --tls-key, got one; give both")
        return Tls(self.tls_cert, self.tls_key, self.tls_client_ca)


_PANELS = {
    "Policy and server": ("settings", "serve_set", "config_dir"),
    "Where it runs": ("host", "port", "vlagents_port", "address"),
    "Access": ("keys", "insecure", "plain_http", "tls_cert", "tls_key", "tls_client_ca"),
}


@command_of(ServeOptions, _PANELS)
def serve_command(options: ServeOptions) -> None:
    """Serve a policy until Ctrl-C.

    Exit status: 0 if Ctrl-C or SIGTERM ended the server, 2 for invalid settings, 1 for any other
    failure.
    """
    from vlagents_ray.serve.launch.deployment_file import with_dialect, with_gateways_at
    from vlagents_ray.serve.launch.server import running_server

    with errors():
        address = options.address
        keys = options.keys
        insecure = options.insecure

        config = options.deployment()
        if options.vlagents_port is not None:
            config = with_dialect(config, "vlagents", {"port": options.vlagents_port})
        if address is None:
            require_packages(config)

        host = options.host or config.http_options.host
        port = options.port or config.http_options.port
        access: dict[str, Any] = {
            "keys_file": keys,
            "insecure": insecure,
            "plain_http": options.plain_http,
            "tls": options.tls(),
        }
        started = threading.Event()
        with (
            quiet_ray(f"vlagents-ray-serve-{port}", started) as log,
            exit_if_ray_is_lost(RESTART) as loss,
            running_server(config, host=host, port=port, address=address, **access) as server,
        ):
            started.set()
            deployed = with_gateways_at(config, host)
            for line in connection_lines(deployed, server.apps, host, keys, insecure=insecure):
                out.print(line)
            out.print(f"metrics for Prometheus: {', '.join(server.metrics)}")
            if address is None:
                out.print(f"in a Ray program on this machine: vlagents_ray.join({server.url!r})")
            out.print(f"log of Ray, Serve and HAProxy: {log}")
            with contextlib.suppress(KeyboardInterrupt):
                out.print("Ctrl-C stops")
                loss.wait()


def connection_lines(
    config: Deployment,
    urls: Mapping[str, str],
    host: str,
    keys: Path | None = None,
    *,
    insecure: bool = False,
) -> Iterator[str]:
    """Describe how to reach a server.

    Args:
        config: The deployment.
        urls: The URL of each application.
        host: The address on which the server listens.
        keys: The file of the API keys, if an option sets it.
        insecure: Whether the server accepts every client.

    Yields:
        Lines with the URL, the policy and the pages of each application, and the addresses for
        clients of other systems.
    """
    from vlagents_ray.registry import registered_class
    from vlagents_ray.serve.config.deployment import ServerArgs
    from vlagents_ray.serve.launch.deployment_file import IMPORT_PATH, own_settings

    for app in config.applications:
        url = urls[app.name]
        yield f"serving {app.name} at {url}"
        if host == EVERYWHERE:
            yield f"  from other machines: {url.replace(LOOPBACK, socket.gethostname(), 1)}"
        if app.import_path != IMPORT_PATH:
            continue

        args = ServerArgs(**app.args)
        settings = ", ".join(f"{name}={value!r}" for name, value in own_settings(app).items())
        suffix = f" ({settings})" if settings else ""
        yield f"  policy: {args.policy}{suffix}"

        needs_key = not insecure
        if needs_key and keys is None:
            with contextlib.suppress(ConfigError):  # the key file is on the cluster's machines
                needs_key = args.access.keys() is not None
        curl = ""
        if needs_key:
            ca = "--cacert CA.pem " if url.startswith("https") else ""
            curl = f'curl {ca}-H "Authorization: Bearer $VLAGENTS_RAY_API_KEY" '
        yield f"  API: {curl}{url}/docs"

        if not (insecure or args.access.insecure):  # with --insecure, there is no live page
            for name in args.parts.on():
                for title, path in registered_class("replica", name).pages.items():
                    yield f"  {title}: {url}{path}"

        for name, dialect in args.dialects.describe().items():
            if "address" in dialect:
                addresses = [dialect["address"]]
            else:
                addresses = [_address(url, path) for path in dialect["paths"]]
            yield f"  {name}: {', '.join(addresses)}"


def _address(url: str, path: str) -> str:
    """Return the address of a dialect's path, such as "WS /openpi" or "POST /act"."""
    method, _, location = path.partition(" ")
    if method == "WS":
        return f"ws{url.removeprefix('http')}{location}"
    return f"{method} {url}{location}"
