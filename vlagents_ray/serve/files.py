"""Deployment files: Ray Serve's own config files, with our settings under `args`, checked before anything starts."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError
from ray.serve.schema import ServeApplicationSchema, ServeDeploySchema

from vlagents_ray.errors import ConfigError, MissingDependency, UnknownPolicy
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.registry import names, policy_class, require
from vlagents_ray.serve.config import POLICY, ServerArgs
from vlagents_ray.serve.dialects.routes import require_fit
from vlagents_ray.serve.environments.host import unloaded_contract
from vlagents_ray.serve.environments.interpreter import check_policy, placed

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


def together(policies: Mapping[str, ServeDeploySchema]) -> ServeDeploySchema:
    """One deployment of several policies, each an application under its name; doors of other dialects stay shut.

    Raises `ConfigError` for a part that holds more than one application.
    """
    applications = []
    for name, part in policies.items():
        if len(part.applications) != 1:
            found = [one.name for one in part.applications]
            raise ConfigError(f"{name}: holds {found}, want one application; serve it and give the URL of one of them")
        app = part.applications[0].model_dump(exclude_unset=True)
        app.get("args", {}).pop("dialects", None)
        applications.append(app | {"name": name, "route_prefix": f"/{name}"})
    return _checked({"applications": applications}, ", ".join(policies))


def with_settings(config: ServeDeploySchema, settings: Mapping[str, Any], *, steps: bool = False) -> ServeDeploySchema:
    """The deployment, with these settings of its policy over the file's; `steps` lets sessions choose any step."""
    changed = config.model_copy(deep=True)
    for app in _ours(changed):
        app.args["config"] = own_settings(app) | dict(settings)
        app.deployments = [one for one in app.deployments if one.name != POLICY]
        if steps:
            app.args["checkpoints"] = (app.args.get("checkpoints") or {}) | {"steps": True}
    return _checked(changed.model_dump(exclude_unset=True), "settings")


def with_replicas_on(config: ServeDeploySchema, gpus: float) -> ServeDeploySchema:
    """The deployment with as many replicas as have room on `gpus`, each on one of its own unless the file says more.

    A policy whose file states a number of replicas, autoscaling, or that it wants no GPU, stays as it is.
    """
    changed = config.model_copy(deep=True)
    for app in _ours(changed):
        resources = {"num_gpus": 1.0} | app.args.get("resources", {})
        replicas = int(gpus / resources["num_gpus"]) if resources["num_gpus"] else 0
        if replicas and app.args.get("replicas") is None and app.args.get("autoscaling") is None:
            app.args |= {"replicas": replicas, "resources": resources}
    return changed


def listens_at(config: ServeDeploySchema) -> tuple[str, int]:
    """Host and port that the file names, or ours; Serve's own default would listen to everybody."""
    http = config.http_options
    stated = http.model_fields_set
    return http.host if "host" in stated else DEFAULT_HOST, http.port if "port" in stated else DEFAULT_PORT


def own_settings(app: ServeApplicationSchema) -> dict[str, Any]:
    """The policy's settings: `config`, and what stands beside `args` because it may change while the policy runs."""
    beside = [one.user_config for one in app.deployments if one.name == POLICY and isinstance(one.user_config, dict)]
    return {**app.args.get("config", {}), **(beside[0] if beside else {})}


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
            if "environment" in app.args:  # paths in it are this process's; Ray is to see none that are relative
                app.args["environment"] = args.environment.model_dump(exclude_unset=True)
            _require_policy(args, own_settings(app), installed=not (app.runtime_env or {}))
    except ValidationError as error:
        lines = [f"- {'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors()]
        raise ConfigError(f"{source}:\n" + "\n".join(lines)) from error
    return config


def _require_policy(args: ServerArgs, own: dict[str, Any], *, installed: bool) -> None:
    """Build the policy where it will run, of each kind of settings that there may be, and compare it with the dialects.

    A replica compares again. `own` are the deployment's settings. Not `installed`: all that the policy needs comes
    later, by the application's `runtime_env`.
    """
    environment = args.environment
    if not installed:
        if environment.python is None:
            policy_class(args.policy)
        else:
            placed(environment)
        return
    if args.dialects.gr00t is not None:
        require("zmq")
    offered = args.checkpoints.of(partial(build_agent, args.policy, wrappers=args.wrappers), own)
    for wish in offered.examples():
        settings = offered.settings(wish, own)
        if environment.python is not None:
            require_fit(args.dialects, check_policy(environment, args.policy, settings, args.wrappers))
            continue
        try:
            require_fit(args.dialects, unloaded_contract(offered.make(settings)))
        except (MissingDependency, UnknownPolicy):
            if environment.requirements is None:  # else they may bring it
                raise
