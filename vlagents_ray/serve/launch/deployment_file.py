"""Deployment files: Ray Serve's config files with the settings of this package under `args`,
checked before a start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, Field, ValidationError

import vlagents_ray
from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, UnknownPolicy
from vlagents_ray.naming import did_you_mean
from vlagents_ray.overrides import YAML_SUFFIXES, Override, read_config_file, with_overrides
from vlagents_ray.policies.base.checkpoint import CHECKPOINT_STEP, STEP
from vlagents_ray.policies.wrapper import build_agent, unloaded_contract
from vlagents_ray.ray_tools.runtime_env import require_no_secrets
from vlagents_ray.registry import find_entry, policy_class
from vlagents_ray.serve.config.deployment import POLICY, ServerArgs
from vlagents_ray.serve.ports import LOOPBACK
from vlagents_ray.serve.python_env.probe import check_policy, with_process
from vlagents_ray.settings import wrong_settings
from vlagents_ray.yaml_text import read_yaml

if TYPE_CHECKING:
    from ray.serve.schema import ServeDeploySchema

IMPORT_PATH = "vlagents_ray.serve.app:build"
# The keys of an application that Serve need not apply.
_OUR_APP_KEYS = {"name", "route_prefix", "import_path", "args"}


class HttpSettings(BaseModel, extra="allow"):
    """The address at which the server listens; Serve's own default is all interfaces."""

    host: str = LOOPBACK
    port: int = 8000


class Application(BaseModel, extra="allow"):
    """An application of this or another package."""

    name: str = "default"
    route_prefix: Annotated[str, Field(pattern="^/")] | None = "/"
    import_path: str
    args: dict[str, Any] = {}
    runtime_env: dict[str, Any] = {}
    # Settings of Serve and `user_config`, with the deployment's `name`.
    deployments: list[dict[str, Any]] = []


class Deployment(BaseModel, extra="allow"):
    """A deployment file: the parts of Serve's schema that this package reads, without importing
    Ray.
    """

    applications: list[Application] = Field(min_length=1)
    http_options: HttpSettings = HttpSettings()
    proxy_location: Literal["Disabled", "HeadOnly", "EveryNode"] | None = None

    @property
    def plain(self) -> bool:
        """Whether all applications belong to this package and have no settings that Serve must
        apply.
        """
        if self.model_extra or self.http_options.model_extra:
            return False
        if our_apps(self) != self.applications:
            return False
        return all(
            app.model_dump(exclude_defaults=True).keys() <= _OUR_APP_KEYS
            for app in self.applications
        )

    def for_serve(self) -> ServeDeploySchema:
        """Return the file as Serve's schema.

        Raises:
            ValidationError: A setting of Serve is wrong.
        """
        from ray.serve.schema import ServeDeploySchema  # this import takes a second

        return ServeDeploySchema.model_validate(self.model_dump(exclude_unset=True))


def deployment(policy: str, *, step_follows: bool = False, **args: Any) -> Deployment:
    """Return the deployment of one policy, in the form in which `read_deployment` reads it from a
    file. `args` are fields of `ServerArgs`.
    """
    app = {
        "name": policy.rpartition(":")[2],
        "route_prefix": "/",
        "import_path": IMPORT_PATH,
        "args": {"policy": policy, **args},
    }
    return _checked({"applications": [app]}, f"policy {policy!r}", step_follows)


def read_deployment(
    source: str,
    args: Mapping[str, Any] | None = None,
    *,
    overrides: Sequence[Override] = (),
    app: str | None = None,
    step_follows: bool = False,
) -> Deployment:
    """Read and check a deployment.

    Args:
        source: A YAML file, or the name of a policy.
        args: The args of a policy that is given by its name.
        overrides: Changes of the args of the only policy of the deployment, such as
            `batch.max_size=8` or `config.gain=0.3`.
        app: The application that `overrides` change, if the file has several applications.
        step_follows: Whether `checkpoint_step` is set later, so that a checkpoint with `{step}` may
            lack it.

    Raises:
        ConfigError: The file or a setting is invalid.
    """
    path = Path(source)
    if path.suffix in YAML_SUFFIXES:
        if args:
            raise ConfigError(
                f"expected no settings in addition to the file {source!r}, got {sorted(args)}; "
                "edit the file"
            )
        return _deployment_of_file(path, overrides, app, step_follows=step_follows)

    entry = find_entry("policies", source)
    if ":" not in source and entry is None:
        _refuse_unknown(source, path)

    policy_args = dict(args or {})
    if entry is not None and entry.weights and "checkpoint" not in policy_args.get("config", {}):
        policy_args["config"] = _settings_of_checkout(source) | policy_args.get("config", {})
    changed_args = with_overrides(policy_args, overrides)
    return deployment(source, step_follows=step_follows, **changed_args)


def _deployment_of_file(
    file: Path, overrides: Sequence[Override], app: str | None, *, step_follows: bool
) -> Deployment:
    """Read a deployment file, change the args of its application `app`, and check it."""
    config = _unchecked(file)
    if not overrides:
        return _checked(config.model_dump(exclude_unset=True), str(file), step_follows)

    application = _application_to_change(config, str(file), overrides[0], app)
    if any(override.path[0] == "config" for override in overrides):
        # Otherwise a value in `user_config` would take priority over the changed setting.
        application.args["config"] = own_settings(application)
        for settings_of_serve in application.deployments:
            if settings_of_serve.get("name") == POLICY:
                settings_of_serve.pop("user_config", None)
    application.args = with_overrides(application.args, overrides)
    return _checked(config.model_dump(exclude_unset=True), str(file), step_follows)


def _unchecked(file: Path) -> Deployment:
    """Read a deployment file, without checking the args of its policies."""
    document = read_config_file(
        file, "deployment file", "`applications`", cure="; a checkout has deployments/"
    )
    try:
        return Deployment.model_validate(document)
    except ValidationError as error:
        raise ConfigError(f"{file}: {wrong_settings(error, Deployment)}") from error


def _application_to_change(
    config: Deployment, source: str, override: Override, app: str | None
) -> Application:
    """Return the application whose args are changed.

    Raises:
        ConfigError: The file has several applications, or no application with this name.
    """
    applications = {application.name: application for application in our_apps(config)}
    if app is None and len(applications) == 1:
        [application] = applications.values()
        return application
    if app in applications:
        return applications[str(app)]
    raise override.error(
        f"expected a file with one policy, got {sorted(applications)} in {source}; change the file"
    )


def _refuse_unknown(source: str, path: Path) -> None:
    """Raise an error that explains the likely mistake, for a source that is not a
    registered name.
    """
    if path.name and path.with_suffix(".py").is_file():
        module = ".".join(path.parts).removesuffix(".py")
        raise UnknownPolicy(
            f"policy: expected a class, such as '{module}:MyPolicy', got the module {source!r}"
        )
    if "/" in source:
        raise UnknownPolicy(
            f"policy: expected a policy or a deployment file, got {source!r}; for a checkpoint, "
            "give the file of its family, as in deployments/lerobot.yaml --set "
            f"checkpoint={source}"
        )
    if path.is_dir():
        raise UnknownPolicy(
            f"policy: expected a policy or a deployment file (.yaml), got the folder {source!r}"
        )
    policy_class(source)  # raises an error with the list of choices


def _settings_of_checkout(policy: str) -> dict[str, Any]:
    """Return the settings in the deployment file of the checkout that has this policy's weights;
    empty if there is no such checkout.
    """
    for folder in (Path(), Path(vlagents_ray.__file__).parents[1]):
        file = folder / "deployments" / f"{policy}.yaml"
        if file.is_file():
            settings: dict[str, Any] = read_yaml(file)["applications"][0]["args"]["config"]
            return settings | {"checkpoint": str(folder / settings["checkpoint"])}
    return {}


def policy_application(
    source: str, app: str | None = None, overrides: Sequence[Override] = ()
) -> Application:
    """Return the application `app` of a deployment, or its only application, with `overrides`
    applied to its args.
    """
    config = read_deployment(source, overrides=overrides, app=app)
    applications = {application.name: application for application in our_apps(config)}
    if app is None and len(applications) == 1:
        [app] = applications
    if app is None or app not in applications:
        raise ConfigError(
            f"{source}: expected one of the policies {sorted(applications)} as the app, got {app!r}"
        )
    return applications[app]


def with_gateways_at(config: Deployment, host: str) -> Deployment:
    """Return the deployment, with `host` as the default host of dialects that have their own
    port.
    """
    changed = config.model_copy(deep=True)
    for app in our_apps(changed):
        for name in ServerArgs(**app.args).dialects.gateways():
            app.args["dialects"][name].setdefault("host", host)
    return changed


def with_dialect(config: Deployment, name: str, settings: Mapping[str, Any]) -> Deployment:
    """Return the deployment of one application with these settings of a dialect, which replace the
    dialect's settings in the file.
    """
    changed = config.model_copy(deep=True)
    apps = our_apps(changed)
    if len(apps) != 1:
        raise ConfigError(
            f"--{name}-port: expected a file with one policy, got {len(apps)}; set the port in the "
            "file"
        )

    args = apps[0].args
    dialects = args.setdefault("dialects", {})
    dialects[name] = {**(dialects.get(name) or {}), **settings}
    ServerArgs(**args)
    return changed


def only_application(name: str, config: Deployment) -> Application:
    """Return the only application of a deployment for the policy `name`.

    Raises:
        ConfigError: The deployment has several applications.
    """
    if len(config.applications) != 1:
        names = [app.name for app in config.applications]
        raise ConfigError(
            f"{name}: expected one application, got {names}; serve the file, and give "
            "the URL of one of its applications"
        )
    return config.applications[0]


def together(policies: Mapping[str, Deployment]) -> Deployment:
    """Join several policies into one deployment without dialects, in which each policy is an
    application under its name.

    Raises:
        ConfigError: One of the deployments contains more than one application.
    """
    applications = []
    for name, config in policies.items():
        app = only_application(name, config).model_dump(exclude_unset=True)
        app.get("args", {}).pop("dialects", None)
        applications.append(app | {"name": name, "route_prefix": f"/{name}"})
    return _checked({"applications": applications}, ", ".join(policies))


def with_settings(
    config: Deployment,
    settings: Mapping[str, Any],
    *,
    step_follows: bool = False,
) -> Deployment:
    """Return the deployment with these settings of its policies, which replace the settings in the
    file. See `read_deployment` for `step_follows`.
    """
    changed = config.model_copy(deep=True)
    for app in our_apps(changed):
        app.args["config"] = own_settings(app) | dict(settings)
        app.deployments = [
            settings_of_serve
            for settings_of_serve in app.deployments
            if settings_of_serve.get("name") != POLICY
        ]
    return _checked(changed.model_dump(exclude_unset=True), "settings", step_follows)


def with_user_config(config: Deployment, app: str, settings: Mapping[str, Any]) -> Deployment:
    """Return the deployment with these settings of a policy in `user_config`, which Serve can
    change without new replicas.

    Args:
        config: The deployment.
        app: The application of the policy.
        settings: The settings, which are added to the `user_config` in the file.
    """
    changed = config.model_copy(deep=True)
    [application] = [one for one in our_apps(changed) if one.name == app]
    of_policy = [options for options in application.deployments if options.get("name") == POLICY]
    if not of_policy:
        of_policy = [{"name": POLICY}]
        application.deployments = application.deployments + of_policy
    options = of_policy[0]
    options["user_config"] = (options.get("user_config") or {}) | dict(settings)
    return _checked(changed.model_dump(exclude_unset=True), "user_config")


def with_replicas_on(config: Deployment, gpus: float) -> Deployment:
    """Return the deployment with as many replicas as fit on `gpus`. Each replica uses one GPU,
    unless the file sets another number.

    A policy is not changed if its file sets the number of replicas, autoscaling, or zero GPUs.
    """
    changed = config.model_copy(deep=True)
    for app in our_apps(changed):
        resources = {"num_gpus": 1.0} | app.args.get("resources", {})
        replicas = int(gpus / resources["num_gpus"]) if resources["num_gpus"] else 0
        if replicas and app.args.get("replicas") is None and app.args.get("autoscaling") is None:
            app.args |= {"replicas": replicas, "resources": resources}
    return changed


def own_settings(app: Application) -> dict[str, Any]:
    """Return the policy's settings: `config`, and `user_config`, which may change while the
    policy runs.
    """
    settings = dict(app.args.get("config", {}))
    for settings_of_serve in app.deployments:
        if settings_of_serve.get("name") == POLICY:
            settings.update(settings_of_serve.get("user_config") or {})
            break
    return settings


def settings_in_file(file: str) -> dict[str, Any]:
    """Return the settings of the only policy of a deployment file, without building the policy.

    Raises:
        ConfigError: The file is invalid, or has several applications.
    """
    return own_settings(only_application(file, _unchecked(Path(file))))


def declared_contract(config: Deployment) -> Contract | None:
    """Return the contract of a deployment's only policy, without loading the policy.

    Returns:
        The contract; None if the policy has no contract before it is loaded or cannot be built
        here, or if the deployment has several policies.
    """
    app = config.applications[0]
    if len(config.applications) > 1 or app.import_path != IMPORT_PATH or app.runtime_env:
        return None

    return _contract(ServerArgs(**app.args), own_settings(app))


def our_apps(config: Deployment) -> list[Application]:
    """Return the applications of a deployment that serve a policy."""
    return [app for app in config.applications if app.import_path == IMPORT_PATH]


def _checked(document: object, source: str, step_follows: bool = False) -> Deployment:
    """Check the `args` of this package and the settings of Serve, before anything starts, and
    return the document.
    """
    try:
        config = Deployment.model_validate(document)
        if not config.plain or len(config.applications) > 1:
            config.for_serve()

        for app in config.applications:
            require_no_secrets(app.runtime_env)
            for settings_of_serve in app.deployments:
                options = settings_of_serve.get("ray_actor_options") or {}
                require_no_secrets(options.get("runtime_env") or {})
        for app in config.applications:
            meant = did_you_mean(app.import_path, [IMPORT_PATH])
            if app.import_path != IMPORT_PATH and meant:
                raise ConfigError(
                    f"{source}: {app.name}: import_path: expected {IMPORT_PATH!r}, got "
                    f"{app.import_path!r}{meant}"
                )

        for app in our_apps(config):
            args = ServerArgs(**app.args)
            # Relative paths refer to this process's folder, so Ray gets absolute paths.
            if "environment" in app.args:
                app.args["environment"] = args.environment.model_dump(exclude_unset=True)
            if "parts" in app.args:
                app.args["parts"] = args.parts.model_dump(exclude_unset=True)
            _require_policy(
                args, own_settings(app), installed=not app.runtime_env, step_follows=step_follows
            )
    except ValidationError as error:
        model = ServerArgs if error.title == ServerArgs.__name__ else Deployment
        raise ConfigError(f"{source}: {wrong_settings(error, model)}") from error
    return config


def _require_policy(
    args: ServerArgs, config: dict[str, Any], *, installed: bool, step_follows: bool
) -> None:
    """Build the policy in its environment, and check that the dialects fit its contract. A replica
    repeats the check.

    Args:
        args: The settings of the server.
        config: The policy's own settings.
        installed: Whether the policy's packages are installed here; otherwise the application's
            `runtime_env` adds them.
        step_follows: Whether a missing checkpoint step is set later.
    """
    if not installed:
        if args.environment.python is None:
            policy_class(args.policy)
        else:
            with_process(args.environment)
        return

    args.dialects.require_packages()
    has_place = any(isinstance(value, str) and STEP in value for value in config.values())
    lacks_step = has_place and config.get(CHECKPOINT_STEP) is None
    settings = config | {CHECKPOINT_STEP: 0} if step_follows and lacks_step else config
    args.dialects.require_fit(_contract(args, settings))


def _contract(args: ServerArgs, settings: dict[str, Any]) -> Contract | None:
    """Build the policy in its environment with these settings, and return its contract; None if it
    has no contract before it is loaded.
    """
    if args.environment.python is not None:
        return check_policy(args.environment, args.policy, settings, args.wrappers)
    return unloaded_contract(build_agent(args.policy, settings, args.wrappers))
