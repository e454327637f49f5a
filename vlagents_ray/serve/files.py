"""Deployment files: Ray Serve's own config files, with our settings under `args`, checked before anything starts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError
from ray.serve.schema import ServeDeploySchema

from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Agent
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.registry import names, policy_class, require
from vlagents_ray.serve.config import ServerArgs
from vlagents_ray.serve.dialects.routes import require_fit

IMPORT_PATH = "vlagents_ray.serve.app:build"
DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8000


def deployment(policy: str, **args: Any) -> ServeDeploySchema:
    """The deployment of one policy, as if read from a file."""
    return _checked({"applications": [_application(policy, {"policy": policy, **args})]}, f"policy {policy!r}")


def read_deployment(source: str, overrides: Mapping[str, Any] | None = None) -> ServeDeploySchema:
    """A deployment from a YAML file, or of a policy by its name (`overrides` are its args)."""
    path = Path(source)
    if path.suffix in (".yaml", ".yml"):
        if not path.is_file():
            raise ConfigError(f"deployment file {source!r} does not exist")
        if overrides:
            raise ConfigError(f"{source!r} holds the settings; edit it instead of giving {sorted(overrides)}")
        try:
            document = yaml.safe_load(path.read_text())
        except yaml.YAMLError as error:
            raise ConfigError(f"{source}: not YAML ({error})") from error
        return _checked(document, source)
    if ":" not in source and source not in names("policies"):
        policy_class(source)  # raises with the list of what there is
    return deployment(source, **(overrides or {}))


def server_args(source: str, app: str | None = None) -> ServerArgs:
    """The settings of one policy of a deployment: the one called `app`, or the only one there is."""
    ours = {one.name: one for one in _ours(read_deployment(source))}
    if app is None and len(ours) == 1:
        [app] = ours
    if app not in ours:
        raise ConfigError(f"{source}: holds the policies {sorted(ours)}, got {app!r}; name one of them as the app")
    return ServerArgs(**ours[app].args)


def with_gateways_at(config: ServeDeploySchema, host: str) -> ServeDeploySchema:
    """The deployment, in which a dialect with a port of its own that names no host listens where the server does."""
    changed = config.model_copy(deep=True)
    for app in _ours(changed):
        for name in ServerArgs(**app.args).dialects.gateways():
            app.args["dialects"][name].setdefault("host", host)
    return changed


def with_dialect(config: ServeDeploySchema, name: str, settings: Mapping[str, Any]) -> ServeDeploySchema:
    """The deployment of one application, with these settings of a dialect in place of the file's."""
    changed = config.model_copy(deep=True)
    if len(_ours(changed)) != 1:
        raise ConfigError(f"--{name}-port: the file holds {len(_ours(changed))} policies, want one; write it there")
    args = _ours(changed)[0].args
    dialects = args.setdefault("dialects", {})
    dialects[name] = {**(dialects.get(name) or {}), **settings}
    ServerArgs(**args)
    return changed


def listens_at(config: ServeDeploySchema) -> tuple[str, int]:
    """Host and port that the file names, or ours; Serve's own default would listen to everybody."""
    http = config.http_options
    stated = http.model_fields_set
    return http.host if "host" in stated else DEFAULT_HOST, http.port if "port" in stated else DEFAULT_PORT


def _ours(config: ServeDeploySchema) -> list[Any]:
    return [app for app in config.applications if app.import_path == IMPORT_PATH]


def _application(name: str, args: dict[str, Any]) -> dict[str, Any]:
    short = name.rpartition(":")[2]
    return {"name": short, "route_prefix": "/", "import_path": IMPORT_PATH, "args": args}


def _checked(document: object, source: str) -> ServeDeploySchema:
    """The document as Serve's schema, with our own args checked before anything is started."""
    try:
        config = ServeDeploySchema.model_validate(document)
        for app in _ours(config):
            args = ServerArgs(**app.args)
            agent = build_agent(args.policy, args.config, args.wrappers)
            if not (app.runtime_env or {}):
                _require_fit(args, agent)
                if args.dialects.gr00t is not None:
                    require("zmq")
    except ValidationError as error:
        lines = [f"- {'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors()]
        raise ConfigError(f"{source}:\n" + "\n".join(lines)) from error
    return config


def _require_fit(args: ServerArgs, agent: Agent) -> None:
    """Compare dialects and policy, if it can state its contract before it is loaded; a replica compares again."""
    try:
        contract = agent.contract
    except Exception:  # noqa: BLE001 - its own, for want of what `initialize` brings
        return
    require_fit(args.dialects, contract)
