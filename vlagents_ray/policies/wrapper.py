"""Wrappers, which change the observations of a policy, and the construction of wrapped policies."""

from __future__ import annotations

import inspect
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar, TypeVar, cast

from vlagents_ray.abilities import (
    Speculative,
    Trainable,
    ability,
    bind,
    is_marked,
    observation_arguments,
)
from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, NotTrainable, UnknownPolicy
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.base.checkpoint import CHECKPOINT, CHECKPOINT_STEP, STEP, at_step
from vlagents_ray.policies.outcomes import compute_valid
from vlagents_ray.registry import find_entry, policy_class, wrapper_class
from vlagents_ray.settings import wrong_settings

T = TypeVar("T")


class Wrapper(Agent):
    """An agent that passes changed observations to an inner agent.

    `Config` and `shared` have the same meaning as for any agent. Each session has a copy of the
    wrapper and of the inner agent. All abilities of the inner agent (`vlagents_ray.abilities`) are
    also the wrapper's, unless it defines them itself.

    Args:
        agent: The inner agent.
        config: An instance of `Config`, if the class has one.
    """

    repeatable: ClassVar[bool] = False
    """Whether `change_batch` may be called twice with an observation, on any thread: its result
    depends on no other observation, and the call takes little time.

    If so, observations are prepared through the wrapper (`vlagents_ray.abilities.Prepares`).
    """

    def __init__(self, agent: Agent, config: Any = None) -> None:
        self.agent, self.config = agent, config

    @classmethod
    def around(cls, agent: Agent, settings: Mapping[str, Any]) -> Wrapper:
        """Wrap an agent.

        Args:
            agent: The inner agent.
            settings: The settings of the wrapper in the deployment file.

        Raises:
            ConfigError: A setting is wrong.
        """
        try:
            if cls.Config is None and not settings:
                return cls(agent)
            return cls(agent, cls.Config(**settings))  # type: ignore[misc]
        except (TypeError, ValueError) as error:
            message = wrong_settings(error, cls.Config) if isinstance(error, ValueError) else error
            raise ConfigError(f"wrapper {cls.__name__}: {message}") from error

    def begin(self, obs: Obs, instruction: str | None) -> Obs:
        """Begin an episode with its first observation, and return the first observation for the
        inner agent.
        """
        return obs

    def change_batch(
        self, obs: Sequence[Obs], sessions: Sequence[Wrapper]
    ) -> list[Obs | Exception]:
        """Change an observation of each session.

        Args:
            obs: The observations.
            sessions: The copy of the wrapper of each session.

        Returns:
            The observations for the inner agent. An exception instead of an observation is the
            result of that session's request; the other requests continue.
        """
        return list(obs)

    @property
    def contract(self) -> Contract | None:
        """The contract of the inner agent, unless the wrapper changes it."""
        return self.agent.contract

    def shared_objects(self) -> list[Any]:
        return [*super().shared_objects(), *self.agent.shared_objects()]

    def forwarded(self, protocol: type[T]) -> T | None:
        """Return an ability of the inner agent that receives the observations changed by the
        wrapper.

        Args:
            protocol: The protocol of the ability.

        Returns:
            The inner agent's ability; None if the inner agent does not have it, or if it requires
            changing an observation twice and the wrapper is not `repeatable`.
        """
        inner = ability(self.agent, protocol)
        if inner is None or type(self).change_batch is Wrapper.change_batch:
            return inner
        declared: type = protocol
        if not observation_arguments(declared):
            return inner
        if is_marked(protocol, Speculative) and not self.repeatable:
            return None
        return cast(T, _ChangesObservations(self, inner, protocol))

    def initialize(self) -> None:
        self.agent.initialize()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return self.agent.reset(self.begin(obs, instruction), instruction, **kwargs)

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Change the observations, and compute the inner agent's actions.

        The result for an observation that could not be changed is an exception.
        """
        changed = self.change_batch(obs, sessions)  # type: ignore[arg-type]
        inner_sessions = []
        for original, changed_obs, session in zip(obs, changed, sessions, strict=True):
            if not isinstance(changed_obs, Exception):
                changed_obs.prepared = original.prepared
                inner_sessions.append(session.agent)  # type: ignore[attr-defined]

        def act(observations: list[Obs]) -> list[Act | Exception]:
            return self.agent.act_batch(observations, inner_sessions)

        return compute_valid(changed, act)

    def close(self) -> None:
        self.agent.close()


class _ChangesObservations:
    """An ability of a wrapper's inner agent, with the methods of its protocol, that receives
    changed observations.
    """

    def __init__(self, wrapper: Wrapper, inner: Any, protocol: type) -> None:
        self._wrapper, self._inner, self._protocol = wrapper, inner, protocol

    def __getattr__(self, name: str) -> Any:
        member = getattr(self._inner, name)
        argument = observation_arguments(self._protocol).get(name)
        if argument is None:
            return member

        def call(*args: Any, **kwargs: Any) -> Any:
            bound = bind(self._protocol, name, args, kwargs)
            [changed] = self._wrapper.change_batch([bound.arguments[argument]], [self._wrapper])
            if isinstance(changed, Exception):
                raise changed
            bound.arguments[argument] = changed
            return member(*bound.args[1:], **bound.kwargs)

        return call


def unwrapped(agent: Agent) -> Agent:
    """Return the policy inside all of its wrappers."""
    while isinstance(agent, Wrapper):
        agent = agent.agent
    return agent


def require_trainable(agent: Agent) -> Trainable:
    """Return an agent's ability to receive new weights.

    Raises:
        NotTrainable: The agent does not have this ability.
    """
    trainable = ability(agent, Trainable)
    if trainable is None:
        raise NotTrainable(
            f"{type(unwrapped(agent)).__name__}: names no parameters to train; derive it from "
            "vlagents_ray.TrainableAgent, and set `trainable` to the name of the attribute with "
            "its torch module or its dicts of arrays"
        )
    return trainable


def build_agent(
    policy: str,
    config: Mapping[str, Any],
    wrappers: Sequence[str | Mapping[str, Mapping[str, Any]]] = (),
) -> Agent:
    """Make a policy with its wrappers.

    Args:
        policy: A registered name, or "module:Class".
        config: The settings of the policy. `checkpoint_step` replaces `{step}` in the texts.
        wrappers: Names, or {name: settings}. The first one is the outermost wrapper, which receives
            the robot's observations.

    Returns:
        The outermost wrapper, or the policy.

    Raises:
        UnknownPolicy: There is no such policy.
        ConfigError: A setting or the name of a wrapper is wrong.
    """
    cls = policy_class(policy)
    if not issubclass(cls, Agent):
        raise UnknownPolicy(
            f"policy {policy!r}: expected an Agent; derive the class from vlagents_ray.Agent"
        )
    if cls.act is Agent.act and cls.act_batch is Agent.act_batch:
        raise ConfigError(
            f"policy {policy!r}: expected a class that defines act or act_batch, got {cls.__name__}"
        )

    if CHECKPOINT_STEP in config:
        config = _at_step(policy, cls, config)
    try:
        agent: Agent = cls.from_config(config)
    except ConfigError as error:
        raise ConfigError(f"{error}{_example_of(policy, cls, config)}") from error

    for entry in reversed(wrappers):
        agent = _wrapped(agent, entry)
    return agent


def _at_step(policy: str, cls: type[Agent], config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings with the training step in each text that contains `{step}`, so that a
    class needs no setting of its own for it.

    The settings of a class that replaces `{step}` itself, see `ModelConfig.replaces_step`, are
    returned as they are.

    Raises:
        ConfigError: The class has no setting `checkpoint_step`, and no text contains `{step}`.
    """
    if getattr(cls.Config, "replaces_step", False):
        return dict(config)

    step = config[CHECKPOINT_STEP]
    settings: dict[str, Any] = {}
    for name, value in config.items():
        settings[name] = at_step(value, step) if isinstance(value, str) else value
    if CHECKPOINT_STEP not in (getattr(cls.Config, "model_fields", None) or _parameters(cls)):
        del settings[CHECKPOINT_STEP]
        if all(settings[name] == config[name] for name in settings):
            raise ConfigError(
                f"policy {policy!r}: expected {STEP} in a setting, which stands for the training "
                f"step {step}, got {dict(settings)}; write it there, such as "
                f"{CHECKPOINT}: runs/a/{STEP}, or give the class a setting `{CHECKPOINT_STEP}`"
            )
    return settings


def _parameters(cls: type[Agent]) -> Collection[str]:
    """Return the names of the arguments with which a class is constructed."""
    return inspect.signature(cls).parameters


def _wrapped(agent: Agent, entry: str | Mapping[str, Mapping[str, Any]]) -> Wrapper:
    """Return an agent in the wrapper that an entry describes: a name, or {name: settings}."""
    settings_by_name = {entry: {}} if isinstance(entry, str) else dict(entry)
    if len(settings_by_name) != 1:
        raise ConfigError(
            "wrappers: expected one name with its settings in each entry, got "
            f"{sorted(settings_by_name)} in one; write an entry for each"
        )

    [(name, settings)] = settings_by_name.items()
    cls = wrapper_class(name)
    if not issubclass(cls, Wrapper):
        raise ConfigError(
            f"wrappers: {name!r}: expected a subclass of {Wrapper.__module__}.Wrapper, got "
            f"{cls.__name__}"
        )
    wrapper: Wrapper = cls.around(agent, settings or {})
    return wrapper


def _example_of(policy: str, cls: type[Agent], config: Mapping[str, Any]) -> str:
    """Return the end of an error message, which tells where to find examples of missing settings.

    Returns:
        A sentence that names a file and a page; empty if `config` lacks no setting.
    """
    fields = getattr(cls.Config, "model_fields", {})
    missing = any(field.is_required() and name not in config for name, field in fields.items())
    entry = find_entry("policies", policy)
    if not missing or entry is None:
        return ""
    page = policy if entry.page is None else entry.page
    if "://" in page:
        return f". {page} explains it"
    file, _, section = page.partition("#")
    docs_page = f"docs/policies/{file}.md" + (f"#{section}" if section else "")
    return (
        f". deployments/{entry.deployment or policy}.yaml of a checkout has an example, and "
        f"{docs_page} explains it"
    )


def unloaded_contract(agent: Agent) -> Contract | None:
    """Return the contract of a policy before it is loaded; None if the contract is known only
    after loading.
    """
    try:
        return agent.contract
    except Exception:  # noqa: BLE001 - a policy may raise any error before `initialize`
        return None
