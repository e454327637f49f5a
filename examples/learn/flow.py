"""Reinforcement learning from pixels, which makes the reference policy, a flow matching policy,
faster.

    python examples/learn/flow.py learn grpo --out runs/grpo-0
    python examples/learn/flow.py learn ppo --seed 1 --out runs/ppo-1
    python examples/learn/flow.py compare runs/grpo-0 runs/grpo-1

An action of the learner is an action chunk, with the log-probability of the chunk's random steps
(Flow-SDE). Policy, rollouts and learner share this process, without Ray. With --max-lag, the policy
is served, and a worker runs episodes while the learner learns. docs/tutorials/learn.md explains it.
It needs torch, pyarrow and a checkout.
"""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
import pyarrow as pa
import torch
import typer
from grpo import group_advantages
from learner import advantages, episodes, until_solved
from pydantic import BaseModel, ConfigDict

from vlagents_ray import Obs
from vlagents_ray.cli.console import errors
from vlagents_ray.cli.ray_session import quiet_ray
from vlagents_ray.evaluate import EvalConfig, Results, compare
from vlagents_ray.evaluate.plan.config import Count, Retries, Seed
from vlagents_ray.policies.base.model_inputs import state_vector
from vlagents_ray.policies.flow import logprob_of_chain
from vlagents_ray.policies.reference import Reference
from vlagents_ray.policies.reference.checkpoint import (
    CAMERAS,
    CONFIG,
    WEIGHTS,
    normalised,
    pixels,
    read_checkpoint,
)
from vlagents_ray.policies.reference.network import read_network
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import deployment, together
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray.serve.local_agent import LocalPolicy
from vlagents_ray.weights.safetensors import write_values
from vlagents_ray_learn import (
    Publisher,
    RolloutPlan,
    Rollouts,
    TrainingEvaluation,
    answers,
    arrays,
    log_ratio,
)

CHECKPOINT = Path(__file__).parents[2] / "examples" / "reference" / "pretrained"
ENV = ROBOT = "tabletop"
ENV_OPTIONS: dict[str, Any] = {"cameras": ["front", "wrist"], "width": 64, "height": 64}
EXECUTE = 4  # executed rows of a chunk
TICKS = 40  # ticks of a training episode; with fewer ticks, too few episodes are solved at first
NUM_ENVS = 64  # number of environments whose calls share a batch
# Ticks of the short and the long evaluation. The policy should become faster, and remain as
# reliable.
SHORT, LONG = 32, 80
TRAINING = 20_000_000  # first seed of the training episodes; the seeds of evaluations begin at 0
# The modules of the flow. Only these are trained, as in πRL.
HEAD = ("noisy", "when", "why", "blocks", "result")
# Noise level of the random steps; larger deviations change the reward by more, and are thus more
# informative.
NOISE = 0.6
DISCOUNT = 0.96  # per tick
CLIP = 0.2  # clip of PPO's ratio (arXiv 1707.06347)
BATCH = 1024  # chunks per optimizer step
RATE, VALUE_RATE = 2e-4, 1e-3  # learning rates of AdamW, for the flow and for the value

Method = Literal["grpo", "ppo"]
app = typer.Typer(pretty_exceptions_enable=False)


class FlowPlan(BaseModel):
    """The settings of a run."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: Method
    out: Path
    seed: Seed = 0
    iterations: Count = 20
    episodes: Count = 512  # number of episodes in an iteration
    groups: Count = 8  # episodes from one start state, in "grpo"
    epochs: Count = 2  # number of times that an iteration learns from each chunk
    # Largest age of weights in versions; None: episodes and learner wait for each other.
    max_lag: Retries | None = None
    evaluate_every: Count = 5  # number of iterations between evaluations
    held_out: Count = 500  # episodes of an evaluation, the same for each version


class Learned(NamedTuple):
    """The statistics of a learner's iteration."""

    acts: int  # number of chunks with an advantage
    clipped: float  # share of these chunks' rows that are clipped
    # Standard deviation of the log ratio before the first step, nats; 0 if learner and policy
    # agree.
    log_ratio: float


class FlowLearner:
    """Trains the flow of the reference network with GRPO or PPO.

    The encoders of images and words are not changed.
    """

    def __init__(self, method: Method, seed: int, epochs: int) -> None:
        torch.manual_seed(seed)
        self._method, self._epochs, self._rng = method, epochs, np.random.default_rng(seed)
        self._checkpoint = read_checkpoint(CHECKPOINT)
        self.network = read_network(self._checkpoint.sizes, CHECKPOINT)
        self._trained = {
            n: v for n, v in self.network.named_parameters() if n.partition(".")[0] in HEAD
        }
        width = 2 * self._checkpoint.sizes.head
        self._value = torch.nn.Sequential(
            torch.nn.LayerNorm(width),
            torch.nn.Linear(width, 128),
            torch.nn.SiLU(),
            torch.nn.Linear(128, 1),
        )
        flow, value = list(self._trained.values()), list(self._value.parameters())
        groups = [{"params": flow, "lr": RATE}, {"params": value, "lr": VALUE_RATE}]
        self._optimizer = torch.optim.AdamW(groups, betas=(0.9, 0.99), weight_decay=0.0)
        self.version = 0  # version of the weights: the number of iterations so far

    def state(self) -> dict[str, torch.Tensor]:
        """Return the trained values by name, for a partial push."""
        return {name: value.detach() for name, value in self._trained.items()}

    def improve(self, columns: Mapping[str, np.ndarray]) -> Learned:
        """Take steps of the optimizer on whole episodes.

        Args:
            columns: The transitions, with `logprob` and `replay.chain`. Each chunk has EXECUTE
                transitions.
        """
        contexts, chains = self._contexts(columns), torch.from_numpy(columns["replay.chain"].copy())
        stated = torch.from_numpy(columns["logprob"].reshape(-1, EXECUTE).copy())
        gain, targets = self._advantages(columns, contexts)
        rows, clipped, first = np.flatnonzero(gain.any(1)), list[float](), 0.0
        if not len(rows):
            return Learned(0, 0.0, 0.0)
        for _ in range(self._epochs):
            order = self._rng.permutation(rows)
            for number in np.array_split(order, max(1, round(len(order) / BATCH))):
                batch = torch.from_numpy(number)
                logprob = self._logprob(contexts[batch], chains[batch])
                first = first or log_ratio(logprob.detach(), stated[batch]).std
                ratio, part = (logprob - stated[batch]).exp(), gain[batch]
                loss = -torch.minimum(ratio * part, ratio.clamp(1 - CLIP, 1 + CLIP) * part).mean()
                if targets is not None:
                    loss = (
                        loss
                        + (self._value(contexts[batch]).squeeze(-1) - targets[batch])
                        .square()
                        .mean()
                    )
                clipped.append(float(((ratio - 1).abs() > CLIP).float().mean()))
                self._optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self._trained.values(), 1.0)
                self._optimizer.step()
        self.version += 1
        return Learned(len(rows), float(np.mean(clipped)), first)

    def _advantages(
        self, columns: Mapping[str, np.ndarray], contexts: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return the advantages of the rows of chunks, (A, EXECUTE), and for PPO the targets of the
        chunks' values, (A,).
        """
        if self._method == "grpo":
            return torch.from_numpy(group_advantages(columns, DISCOUNT).reshape(-1, EXECUTE)), None
        rows = first_rows(columns)
        with torch.no_grad():
            value = self._value(contexts).squeeze(-1).numpy()
        success = np.logical_or.reduceat(columns["success"], rows)
        each, targets = advantages(
            {"t": columns["t"][rows], "success": success, "value": value}, DISCOUNT**EXECUTE
        )
        kept = until_solved(columns).reshape(-1, EXECUTE)
        before = kept.any(1)
        gain = kept * ((each - each[before].mean()) / (each[before].std() + 1e-6))[:, None]
        return torch.from_numpy(gain.astype(np.float32)), torch.from_numpy(targets)

    def _logprob(self, contexts: torch.Tensor, chains: torch.Tensor) -> torch.Tensor:
        """Return the log-probabilities of the executed rows of chunks, (B, EXECUTE), nats."""
        ones = torch.ones(len(contexts))
        found = logprob_of_chain(
            lambda a, time: self.network.velocity(contexts, a, time * ones), chains, NOISE
        )
        summed: torch.Tensor = found[:, :EXECUTE].sum(2)
        return summed

    def _contexts(self, columns: Mapping[str, np.ndarray]) -> torch.Tensor:
        """Return the context of the flow from images, state and words for each chunk, (A, C)."""
        rows, robot, found = (
            first_rows(columns),
            self._checkpoint.embodiments[ROBOT],
            list[torch.Tensor](),
        )
        tokens = {text: self._checkpoint.tokens(text) for text in set(columns["instruction"])}
        parts = [name.removeprefix("state.") for name in columns if name.startswith("state.")]
        # This number of images fits into the processor's cache.
        for some in np.array_split(rows, max(1, len(rows) // 64)):
            obs = [
                Obs({}, float(columns["gripper"][i]), {p: columns[f"state.{p}"][i] for p in parts})
                for i in some
            ]
            state = normalised(
                robot,
                np.stack([state_vector(o, robot.state) for o in obs]),
                self._checkpoint.sizes.state,
            )
            images = [
                torch.from_numpy(columns[f"cameras.{robot.cameras[name]}"][some])
                for name in CAMERAS
            ]
            words = torch.from_numpy(np.stack([tokens[columns["instruction"][i]] for i in some]))
            seen = pixels(torch.stack(images, 1)).unbind(1)
            with torch.no_grad():
                found.append(self.network.encode(words, torch.from_numpy(state), *seen))
        return torch.cat(found)


def first_rows(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the index of the first transition of each chunk, (A,) int64."""
    rows: np.ndarray = np.flatnonzero(np.diff(answers(columns), prepend=-1))
    return rows


class FlowRun:
    """A run of iterations: episodes, a learner's steps and a push, with regular evaluations."""

    def __init__(self, plan: FlowPlan) -> None:
        self._plan, self._learner = plan, FlowLearner(plan.method, plan.seed, plan.epochs)
        self._config = {
            "checkpoint": str(CHECKPOINT),
            "embodiment": ROBOT,
            "execute": EXECUTE,
            "noise_level": NOISE,
        }
        self._evaluated = Reference.from_config(self._config)
        self._evaluated.initialize()

    def learn(self) -> None:
        """Train the policy for all iterations of the plan.

        The results are written to the plan's folder, and the new checkpoint to the subfolder
        `checkpoint`.
        """
        plan, learner = self._plan, self._learner
        curve, whole = self._evaluation(SHORT), self._evaluation(LONG)
        self._play(whole)
        with (
            self._policy() as (target, acting),
            Publisher(target) as weights,
            self._rollouts(acting) as rollouts,
        ):
            for iteration in range(plan.iterations):
                if iteration % plan.evaluate_every == 0:
                    self._play(curve)
                begun = time.monotonic()
                columns = arrays(self._episodes(rollouts))
                solved = np.logical_or.reduceat(columns["success"], episodes(columns)[0]).mean()
                played = time.monotonic()
                learned = learner.improve(columns)
                if learned.acts:
                    rollouts.version = weights.push(
                        learner.state(), partial=True, version=learner.version
                    )
                print(
                    f"iteration {iteration + 1}: {solved:.1%} of {plan.episodes} episodes solved, "
                    f"{played - begun:.1f} s; {learned.acts} acts, {learned.clipped:.0%} clipped, "
                    f"log ratio {learned.log_ratio:.1g}, {time.monotonic() - played:.1f} s; "
                    f"{rollouts.stats.stale} stale episodes"
                )
        self._play(curve)
        self._play(whole)
        self._save(plan.out / "checkpoint")

    def _episodes(self, rollouts: Rollouts) -> Any:
        if self._plan.max_lag is None:
            return rollouts.collect(self._plan.episodes)
        return pa.Table.from_batches([next(rollouts) for _ in range(self._plan.episodes)])

    def _evaluation(self, ticks: int) -> TrainingEvaluation:
        plan, options = self._plan, ENV_OPTIONS | {"max_steps": ticks}
        suite = {"envs": [ENV], "env_options": options, "episodes": plan.held_out, "num_envs": 16}
        settings = {
            "policies": [{"name": plan.method, "execute": EXECUTE}],
            "suites": [suite],
            "workers": 0,
        }
        config = EvalConfig.model_validate(
            settings | {"out": plan.out / f"within_{ticks}", "video": "none"}
        )
        return TrainingEvaluation(self._evaluated, config)

    def _play(self, evaluation: TrainingEvaluation) -> None:
        self._evaluated.load_parameters(self._evaluated.parameters() | self._learner.state())
        newest = evaluation.play(self._learner.version).totals[-1]
        print(
            f"{newest.policy_id}: {newest.success_once.rate:.1%} of {self._plan.held_out} held-out "
            "episodes solved"
        )

    @contextlib.contextmanager
    def _policy(self) -> Iterator[tuple[Any, Any]]:
        """Yield the target of pushes, and the policy of a `RolloutPlan`."""
        args = {"config": self._config, "batch": {"max_size": NUM_ENVS}}
        if self._plan.max_lag is None:
            policy = LocalPolicy(
                ServerArgs.model_validate(args | {"policy": "reference"}), self._config
            )
            yield policy.engine, lambda: policy
        else:
            served = together({"flow": deployment("reference", **args)})
            with quiet_ray(None), running_server(served, ingress=False):
                yield "serve://flow", "serve://flow"

    def _rollouts(self, policy: Any) -> Rollouts:
        plan = self._plan
        return Rollouts(
            RolloutPlan(
                ENV,
                policy,
                workers=0 if plan.max_lag is None else 1,
                num_envs=NUM_ENVS,
                groups=plan.groups if plan.method == "grpo" else 1,
                want=("logprob", "replay"),
                max_lag=plan.max_lag,
                seed=TRAINING * (1 + plan.seed),
                env_options=ENV_OPTIONS | {"max_steps": TICKS},
                execute=EXECUTE,
            )
        )

    def _save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(CHECKPOINT / CONFIG, folder)
        with (folder / WEIGHTS).open("wb") as file:
            write_values(
                file,
                {name: value.numpy() for name, value in self._learner.network.state_dict().items()},
            )


@app.command()
def learn(
    method: Annotated[str, typer.Argument(help=f"One of {', '.join(get_args(Method))}.")],
    out: Annotated[Path, typer.Option(help="New folder of the results.")],
    seed: Annotated[int, typer.Option(help="Seed of the training episodes.")] = 0,
    iterations: Annotated[int, typer.Option(min=1)] = 20,
    episodes: Annotated[int, typer.Option(min=1, help="Of an iteration.")] = 512,
    held_out: Annotated[
        int, typer.Option(min=1, help="Number of episodes of an evaluation.")
    ] = 500,
    evaluate_every: Annotated[int, typer.Option(min=1, help="Iterations.")] = 5,
    max_lag: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Run episodes while learning, with weights at most this number of versions old.",
        ),
    ] = None,
) -> None:
    """Improve the reference policy from pixels, using only the reward of the environment."""
    torch.set_num_threads(1)  # the networks are small
    settings = {
        "iterations": iterations,
        "episodes": episodes,
        "held_out": held_out,
        "evaluate_every": evaluate_every,
    }
    run = {"method": method, "out": out, "seed": seed, "max_lag": max_lag}
    with errors(FlowPlan):
        FlowRun(FlowPlan.model_validate(settings | run)).learn()


@app.command("compare")
def compare_runs(
    folders: Annotated[list[Path], typer.Argument(help="Folders of runs with different seeds.")],
) -> None:
    """Compare each run's first and last version on the same seeds, with McNemar's exact test."""
    with errors(FlowPlan):
        for ticks in (SHORT, LONG):
            gains = []
            for folder in folders:
                results = Results.load(folder / f"within_{ticks}")
                versions = sorted(results.policy_ids, key=lambda name: int(name.partition("@")[2]))
                total = compare(results, versions[-1], versions[0]).total
                pairs = total.pairs
                before, after = (pairs.both + pairs.only_b, pairs.both + pairs.only_a)
                gains.append(pairs.difference)
                print(
                    f"{folder}, within {ticks} ticks: {before / pairs.total:.1%} before, "
                    f"{after / pairs.total:.1%} after, of {pairs.total}; p {total.p_value:.2g}"
                )
            if len(gains) > 1:
                print(
                    f"gain: {np.mean(gains):+.1%}, standard deviation {np.std(gains, ddof=1):.1%} "
                    "of runs"
                )


if __name__ == "__main__":
    app()
