"""Train the reference policy for late answers, with corrections by an expert in the simulator.

Options: `python examples/reference/delays.py --help`.

In each of two rounds, the policy drives the tabletop while its answers are late, and in a share of
the episodes the expert with noise. At each request, copies of the simulated world execute the rows
that the robot may execute until the answer arrives: the rest of its plan, or such rows with errors.
The expert continues each copy, and its actions are the labels of the later rows (DAgger, arXiv
1011.0686). Then the head of the policy is trained on all labels.
"""

from __future__ import annotations

import copy
import json
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import train
import typer
from reactive import expert_action

from vlagents_ray import Act, Obs
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.envs.tabletop.world import STEP_LIMIT
from vlagents_ray.interface import DELAY, LEFTOVER
from vlagents_ray.policies.reference import Reference
from vlagents_ray.policies.reference.checkpoint import read_checkpoint
from vlagents_ray.ray_tools.git_state import code_in

TOGETHER = 200  # number of episodes that run together
EXECUTE = 4  # executed rows of a chunk, as in the evaluation
LONGEST_DELAY = 8  # ticks
LED = 0.4  # share of the episodes that the expert drives
# Standard deviation of the noise of an expert's action, in units of an action, and its share of the
# actions. Without noise, an expert never shows how to recover (DART, arXiv 1703.09327).
NOISE, NOISY = 0.4, 0.3
ERRONEOUS = 2  # number of prefixes with errors for each request
ERROR = 0.5  # largest standard deviation of their errors, for the whole prefix and for each row


@dataclass
class Robot:
    """A robot of the simulator, with the chunk that it executes."""

    env: Tabletop
    session: Reference
    obs: Obs
    delay: int  # ticks until an answer arrives
    is_led: bool  # whether the expert drives
    rng: np.random.Generator
    rows: np.ndarray = field(default_factory=lambda: np.zeros((0, 4), np.float32))  # left rows
    grip: float = 1.0  # last command of the gripper
    ticks: int = 0
    is_over: bool = False

    def request(self, longest: int) -> Obs:
        """Return the observation with the rest of the plan."""
        count = min(self.delay, len(self.rows), longest)
        info = {LEFTOVER: self.rows, DELAY: count} if count else {}
        return Obs(self.obs.cameras, self.obs.gripper, self.obs.state, info)

    def execute(self, action: np.ndarray, *, look: bool = False) -> None:
        """Execute an action; `look` says whether images of the next observation are needed."""
        if self.is_led and self.rng.random() < NOISY:
            action = action + np.append(self.rng.normal(0, NOISE, 3), 0).astype(np.float32)
        self.env.looked_at = look
        self.obs, _, _, is_late, info = self.env.step(Act(action))
        self.grip, self.ticks = float(action[3]), self.ticks + 1
        self.is_over = bool(info["success"]) or is_late

    def wait(self, longest: int) -> int:
        """Execute the rest of the plan until the answer arrives, and return its number of rows."""
        rows, self.rows = self.rows[: min(self.delay, longest)], self.rows[longest:]
        for tick in range(self.delay):
            if self.is_over:
                break
            still = np.array((0, 0, 0, self.grip), np.float32)
            self.execute(rows[tick] if tick < len(rows) else still)
        return len(rows)

    def begin(self, chunk: np.ndarray, first: int) -> None:
        """Execute the rows of an answer from the first one that is not over until the next request,
        and keep the others.
        """
        end = max(first + 1, EXECUTE)
        for row in range(first, end):
            if self.is_over:
                break
            self.execute(chunk[row], look=row == end - 1)
        self.rows = np.clip(chunk[end:], -1, 1)


def continued(env: Tabletop, prefix: np.ndarray, horizon: int) -> np.ndarray:
    """Return a chunk that begins with given rows, which the expert continues, (H, 4) float32.

    Args:
        env: The environment, which is not changed.
        prefix: The given rows, (P, 4) in [-1, 1].
        horizon: The number of rows, H.
    """
    world, rows = copy.deepcopy(env._world), list(prefix)
    for row in range(horizon):
        if row == len(rows):
            obs = env._observe(world, env._goal, look=False)
            rows.append(expert_action(obs, env.instruction))
        dx, dy, dz, grip = np.clip(rows[row], -1, 1).tolist()
        world.step(dx * STEP_LIMIT, dy * STEP_LIMIT, dz * STEP_LIMIT, (grip + 1) / 2)
    return np.stack(rows).astype(np.float32)


def with_mistakes(rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return rows with errors: of position, and sometimes of time, speed or the gripper."""
    rows, kind, size = rows.copy(), rng.random(), ERROR * rng.random()
    rows[:, :3] += size * (rng.normal(size=(1, 3)) + rng.normal(size=(len(rows), 3)))
    if kind < 0.08:  # The gripper opens or closes too early, or not at all.
        rows[rng.integers(len(rows)) :, 3] *= -1
    elif kind < 0.2:  # late by one or two rows
        late = int(rng.integers(1, 3))
        rows = np.concatenate([np.repeat(rows[:1], late, 0), rows])[: len(rows)]
    elif kind < 0.3:
        rows[:, :3] *= rng.random()
    return np.clip(rows, -1, 1)


@dataclass
class Labels:
    """Chunks of the expert, each for the features of a request and a number of given rows."""

    features: list[torch.Tensor] = field(default_factory=list)  # (F,) float16 each
    given: list[int] = field(default_factory=list)
    rows: list[np.ndarray] = field(default_factory=list)  # (H, 4) each

    def add(self, features: torch.Tensor, robot: Robot, longest: int, horizon: int) -> None:
        """Add the labels of a request: without given rows, with the rest of the plan, and with
        errors.
        """
        rng = robot.rng
        free = continued(robot.env, np.zeros((0, 4)), horizon)
        prefixes = [free[:0]]
        lengths = {min(robot.delay, longest), int(rng.integers(1, longest + 1))}
        prefixes += [robot.rows[:length] for length in lengths if 0 < length <= len(robot.rows)]
        for _ in range(ERRONEOUS):
            has_plan = len(robot.rows) >= longest and rng.random() < 0.4
            rows = (robot.rows if has_plan else free)[:longest]
            prefixes.append(with_mistakes(rows, rng)[: rng.integers(1, longest + 1)])
        for prefix in prefixes:
            self.features.append(features)
            self.given.append(len(prefix))
            self.rows.append(free if len(prefix) == 0 else continued(robot.env, prefix, horizon))

    def frames(self) -> train.Frames:
        """Return the labels as frames for the training, one chunk after the other."""
        number, (horizon, dim) = len(self.rows), self.rows[0].shape
        place = torch.arange(number) * horizon
        given = torch.zeros(number * horizon, dtype=torch.int64)
        given[place] = torch.tensor(self.given)
        relative = torch.tensor([True, True, True, False])
        return train.Frames(
            images=np.zeros(0, np.uint8),
            place=place,
            state=torch.zeros(number * horizon, 0),
            objects=torch.full((number * horizon, 1), torch.nan),
            action=torch.from_numpy(np.concatenate(self.rows)),
            tokens=torch.zeros(0),
            given=given,
            end=(place + horizon).repeat_interleave(horizon),
            relative=relative.expand(number * horizon, dim),
            features=torch.stack(self.features),
        )


def gather(checkpoint: Path, labels: Labels, episodes: int, seed: int, longest: int) -> str:
    """Run episodes with a policy, add their labels, and return how many were solved."""
    policy = Reference.from_config(
        {"checkpoint": str(checkpoint), "embodiment": "tabletop", "compile": False}
    )
    policy.initialize()
    network = policy.loaded().network
    horizon = network.sizes.horizon
    seen: list[torch.Tensor] = []
    network.context.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].half()))
    envs = [
        Tabletop(width=64, height=64, cameras=("front", "wrist"), object_state=True)
        for _ in range(min(TOGETHER, episodes))
    ]
    solved = 0
    for first in range(seed, seed + episodes, TOGETHER):
        robots = []
        for number, env in zip(range(first, seed + episodes), envs, strict=False):
            rng, session = np.random.default_rng(number), copy.copy(policy)
            env.looked_at = True
            obs, _ = env.reset(seed=number)
            session.reset(obs, env.instruction, seed=number)
            delay, is_led = int(rng.integers(LONGEST_DELAY + 1)), rng.random() < LED
            robots.append(Robot(env, session, obs, delay, is_led, rng))
        while robots:
            seen.clear()
            requests = [robot.request(longest) for robot in robots]
            answers = policy.act_batch(requests, [robot.session for robot in robots])
            for robot, answer, features in zip(robots, answers, torch.cat(seen), strict=True):
                if isinstance(answer, Exception):
                    raise answer
                labels.add(features, robot, longest, horizon)
                prefix = robot.rows[: min(robot.delay, longest)]
                chunk = continued(robot.env, prefix, horizon) if robot.is_led else answer.rows()
                robot.begin(chunk, robot.wait(longest))
            solved += sum(robot.is_over and robot.ticks < robot.env.max_steps for robot in robots)
            robots = [robot for robot in robots if not robot.is_over]
    return f"{solved} of {episodes} episodes solved"


def main(
    start: Annotated[Path, typer.Argument(help="Checkpoint that is trained further.")],
    out: Annotated[Path, typer.Argument(help="Folder of the new checkpoint.")],
    delays: Annotated[
        int, typer.Option(min=1, help="Largest number of rows with which a chunk begins.")
    ] = 4,
    episodes: Annotated[
        tuple[int, int], typer.Option(help="Numbers of episodes of the two rounds.")
    ] = (2000, 800),
    steps: Annotated[
        tuple[int, int], typer.Option(help="Numbers of training steps of the two rounds.")
    ] = (1200, 800),
    rates: Annotated[
        tuple[float, float], typer.Option(help="Largest learning rates of the two rounds.")
    ] = (1e-3, 6e-4),
    seed: Annotated[
        int, typer.Option(help="Seed of the first episode; seeds of the evaluation begin at 0.")
    ] = 6_000_000,
) -> None:
    """Train in two rounds, and write the checkpoint."""
    torch.set_num_threads(1)
    description = train.for_delays(read_checkpoint(start), ["tabletop"], delays)
    trained = {
        "rounds": [
            {"episodes": number, "steps": count, "rate": rate}
            for number, count, rate in zip(episodes, steps, rates, strict=True)
        ],
        "delays": delays,
        "batch": train.BATCH,
        "seed": seed,
        "torch": torch.__version__,
        "start": json.loads((start / train.MADE).read_text()),
    }
    code = code_in(Path(__file__).parent)
    labels, begun, before = Labels(), time.monotonic(), start
    for number, count, rate in zip(episodes, steps, rates, strict=True):
        done = gather(before, labels, number, seed, delays)
        typer.echo(f"{done}; {len(labels.rows)} labels, {time.monotonic() - begun:.0f} s")
        with tempfile.TemporaryDirectory() as work:
            state = Path(work) / "state.pt"
            network = train.fit(description, labels.frames(), count, 0, state, 1, rate, before)
        trained["parameters"] = sum(value.numel() for value in network.parameters())
        train.save(description, network, out, trained | {"commit": code and code.commit})
        before, seed = out, seed + number


if __name__ == "__main__":
    typer.run(main)
