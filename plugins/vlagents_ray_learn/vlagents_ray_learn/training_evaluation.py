"""Evaluations while a policy is trained, without checkpoints on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from time import monotonic
from typing import Any

from vlagents_ray.client import RemoteAgent
from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, WeightsLost
from vlagents_ray.evaluate.plan.cases import plan_cases, require_envs
from vlagents_ray.evaluate.plan.config import EvalConfig, PushedWeights
from vlagents_ray.evaluate.report.terminal import Progress
from vlagents_ray.evaluate.results.database import FILE
from vlagents_ray.evaluate.results.summary import Summary
from vlagents_ray.evaluate.run import evaluate
from vlagents_ray.interface import POLICY, Act, Agent, Obs
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.policies.wrapper import require_trainable, unwrapped
from vlagents_ray.weights.trainable import evaluation_mode, fingerprint


class TrainingEvaluation:
    """Evaluates a policy while it is trained, within a share of the training's time.

        plan = EvalConfig(
            policies=[{"name": "reach"}], suites=[{"envs": ["tabletop/lift"], "episodes": 50}],
            out="runs/reach"
        )
        evaluation = TrainingEvaluation("serve://reach", plan, share=0.1)
        for _ in range(1000):
            version = weights.push(model.state_dict())
            evaluation.play_if_due(version)

    Results have the format of `vlagents_ray.evaluate.evaluate`, with a checkpoint for each version,
    such as "reach@3". All versions run the same episodes. `play` blocks until the evaluation is
    over, so that the trainer pushes no weights meanwhile.
    """

    def __init__(
        self,
        policy: str | Agent,
        plan: EvalConfig,
        *,
        share: float = 0.1,
        progress: Progress | None = None,
    ) -> None:
        """Check the plan. No episode is run yet.

        Args:
            policy: The URL of the policy's server, to which the versions are pushed, or the agent
                that this process trains. The plan's workers run the episodes of a URL. The episodes
                of an agent are run in this process, each with a copy of the agent that shares its
                weights, as in a server.
            plan: The suites, the folder of results, and one policy with a name and options but
                without `steps`. The policy's `url` and `source` are ignored.
            share: The fraction of the time since this call that evaluations may take, in (0, 1].
            progress: As for `evaluate`.

        Raises:
            ConfigError: The share or the plan is wrong, or there are results and `plan.resume` is
                off.
            UnknownEnv: There is no such env.
        """
        if not isinstance(policy, str | Agent):
            raise ConfigError(
                f"policy: expected an Agent, or the URL of its server, got {type(policy).__name__}"
            )
        if not 0 < share <= 1:
            raise ConfigError(
                f"share: expected a part of the trainer's time in (0, 1], got {share}"
            )
        if len(plan.policies) != 1 or plan.policies[0].steps:
            names = [configured.name for configured in plan.policies]
            raise ConfigError(f"plan: expected one policy without steps, got {names}")
        if (plan.out / FILE).is_file() and not plan.resume:
            raise ConfigError(
                f"{plan.out} already has results; set resume=True in the plan, or choose another "
                "folder"
            )
        require_envs(plan_cases(plan))

        self._policy = policy
        self._plan = plan.model_copy(update={"resume": True})
        self._share = share
        self._progress = progress

        self._began = monotonic()
        self._spent_s = 0.0  # duration of all evaluations
        self._last_s = 0.0  # duration of the last evaluation

    @property
    def is_due(self) -> bool:
        """Whether an evaluation with the duration of the last one would stay within the share.

        The first evaluation is due at once.
        """
        elapsed_s = monotonic() - self._began
        return self._spent_s + self._last_s <= self._share * (elapsed_s + self._last_s)

    def play_if_due(self, version: int) -> Summary | None:
        """If an evaluation is due, evaluate the policy as `play` does; otherwise return None."""
        return self.play(version) if self.is_due else None

    def play(self, version: int) -> Summary:
        """Evaluate the policy now, for example at the end of training.

        Episodes that have a result are not run again.

        Args:
            version: The result of `Publisher.push`. For an agent of this process, an increasing
                number, such as the step of training.

        Returns:
            The summary of all versions so far. The newest version is the last of `totals`.

        Raises:
            WeightsLost: The policy uses another version. Push this version, and call again.
            ConfigError: The existing results of this version belong to other weights, for example
                after a restart of the training.
            NotTrainable: The agent names no parameters to train.
            VLAgentsError: As for `evaluate`.
        """
        begun = monotonic()
        try:
            if isinstance(self._policy, str):
                return self._evaluate_server(self._policy, version)
            return self._evaluate_agent(self._policy, version)
        finally:
            self._last_s = monotonic() - begun
            self._spent_s += self._last_s

    def _evaluate_server(self, url: str, version: int) -> Summary:
        """Evaluate the policy of a server. The server's newest version must be this version."""
        transport, timeout_s = self._plan.policies[0].transport, self._plan.connect_timeout_s
        with RemoteAgent(url, transport=transport, connect_timeout_s=timeout_s) as remote:
            newest = (remote.metadata.get("policy_version") or {}).get("newest") or {}
        if newest.get("version") != version:
            raise WeightsLost(
                f"version: expected {newest.get('version')}, the newest that {url} acts with, got "
                f"{version}; use what the last push returned, once `acknowledged` counts all "
                "replicas"
            )
        plan = self._plan_for(PushedWeights(**newest), url=url)
        return evaluate(plan, progress=self._progress)

    def _evaluate_agent(self, agent: Agent, version: int) -> Summary:
        """Evaluate an agent of this process with its current weights."""
        pushed = PushedWeights(
            version=version, fingerprint=fingerprint(require_trainable(agent).parameters())
        )
        session = _EvaluatedSession(agent, AgentCopies(agent), pushed)
        module = None
        policy = unwrapped(agent)
        trainable: str | None = getattr(policy, "trainable", None)
        if trainable is not None:
            module = attrgetter(trainable)(policy)
        with evaluation_mode(module):
            plan = self._plan_for(pushed).model_copy(update={"workers": 0})
            return evaluate(plan, agent_factory=lambda: session, progress=self._progress)

    def _plan_for(self, pushed: PushedWeights, url: str | None = None) -> EvalConfig:
        """Return the plan of an evaluation of one version."""
        policy = self._plan.policies[0].model_copy(
            update={"source": None, "url": url, "pushed_weights": pushed}
        )
        return self._plan.model_copy(update={"policies": [policy]})


class _EvaluatedSession(Agent):
    """A session of an agent that is trained in this process, with the agent's current weights."""

    def __init__(self, trained: Agent, copies: AgentCopies, pushed: PushedWeights) -> None:
        self._trained, self._copies, self._pushed = trained, copies, pushed
        self._copy = trained

    @property
    def contract(self) -> Contract | None:
        return self._trained.contract

    def sessions(self, number: int) -> list[_EvaluatedSession]:
        """Return further sessions, for parallel episodes."""
        return [_EvaluatedSession(self._trained, self._copies, self._pushed) for _ in range(number)]

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._copy = self._copies.make()
        return self._copy.reset(obs, instruction, **kwargs)

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Compute the answers of the sessions' copies, and add the version of the weights to
        each answer.
        """
        copies = [session._copy for session in sessions if isinstance(session, _EvaluatedSession)]
        acts: list[Act | Exception] = []
        for act in self._trained.act_batch(obs, copies):
            if isinstance(act, Exception):
                acts.append(act)
            else:
                info = {**(act.info or {}), POLICY: self._pushed.model_dump()}
                acts.append(replace(act, info=info))
        return acts
