"""Train the reference policy on LeRobotDatasets, one for each robot: `python reference/train.py --help`.

An interrupted run continues where its last state was kept, and ends with the same weights: each batch, and its noise,
follow from the seed and the number of the step. So does a second run, on the same processor, with the same torch and
as many threads.
"""

from __future__ import annotations

import copy
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

from vlagents_ray.open_loop.recorded import Names, RecordedDataset
from vlagents_ray.policies.base.model_inputs import resize_with_pad, state_vector
from vlagents_ray.policies.reference import (
    CAMERAS,
    CONFIG,
    WEIGHTS,
    Checkpoint,
    Embodiment,
    NetworkSizes,
    ReferenceNetwork,
    normalised,
    pixels,
    words_of,
)
from vlagents_ray.weights.safetensors import write_values

BATCH = 256  # frames
DRAWS = 4  # times that a frame's context is used in a step, each with noise of its own: they cost little
RATE, DECAY, CLIP = 1e-3, 0.01, 1.0  # of AdamW, and the largest norm of a gradient
WARM_UP = 200  # steps, after which the rate falls as a cosine
AVERAGE = 0.999  # of the weights, per step; these are what is saved
KEEP_EVERY = 500  # steps between two kept states
SHOWN_EVERY = 100  # steps between two lines of the log


@dataclass(frozen=True)
class Frames:
    """All frames of all datasets, in the order of robots and episodes."""

    images: np.ndarray  # (N, cameras, S, S, 3) uint8
    state: torch.Tensor  # (N, S) in the network's units
    action: torch.Tensor  # (N, D)
    tokens: torch.Tensor  # (N, L)
    end: torch.Tensor  # (N,) int64, the first frame after the episode's


def read(data: Path, cameras: dict[str, dict[str, str]], kept: Path) -> tuple[Checkpoint, Frames]:
    """Read the dataset of each robot in a folder.

    Args:
        data: The folder, with a dataset for each robot.
        cameras: Of the network -> of the robot, by robot.
        kept: A file for the decoded images, which may be larger than the memory.

    Returns:
        What the checkpoint states, and the frames.
    """
    sizes = NetworkSizes(words=1)
    texts, states, actions, ends, robots, total = list[str](), list[Any](), list[Any](), list[int](), {}, 0
    with kept.open("wb") as file:
        for robot, names in cameras.items():
            dataset = RecordedDataset(data / robot)
            contract = dataset.contract
            if contract is None:
                raise typer.BadParameter(f"{data / robot}: was not exported by this project: its info has no contract")
            parts, own = list(contract.state), list[np.ndarray]()
            for play in dataset.plays():
                [episode] = play.parts
                begun = len(own)
                for step in dataset.steps(episode, Names(), None):
                    seen = [resize_with_pad(step.obs.cameras[names[name]], sizes.side, sizes.side) for name in CAMERAS]
                    file.write(np.stack(seen).tobytes())
                    own.append(state_vector(step.obs, parts))
                    actions.append(step.expected[0])
                ends += [total + len(own)] * (len(own) - begun)
                texts += [episode.instruction] * (len(own) - begun)
            found = np.stack(own)
            action = contract.contract.to_json()["action"]
            robots[robot] = Embodiment(
                cameras=names, state=parts, state_mean=found.mean(0).tolist(), state_std=found.std(0).tolist(),
                action=action,
            )  # fmt: skip
            states.append(normalised(robots[robot], found, sizes.state))
            total += len(own)
    words = sorted({word for text in set(texts) for word in words_of(text)})
    checkpoint = Checkpoint(sizes=sizes.model_copy(update={"words": len(words)}), words=words, embodiments=robots)
    images = np.memmap(kept, np.uint8, "r", shape=(total, len(CAMERAS), sizes.side, sizes.side, 3))
    known = {text: checkpoint.tokens(text) for text in set(texts)}
    return checkpoint, Frames(
        images, torch.from_numpy(np.concatenate(states)), torch.from_numpy(np.stack(actions)),
        torch.from_numpy(np.stack([known[text] for text in texts])), torch.tensor(ends),
    )  # fmt: skip


def batches(frames: int, seed: int) -> Iterator[np.ndarray]:
    """Yield the frames of each step, sorted as they are read from a file: all of them once, then again."""
    for epoch in range(10**9):
        order = np.random.default_rng([seed, epoch]).permutation(frames)
        yield from (np.sort(order[at : at + BATCH]) for at in range(0, max(frames - BATCH, 0) + 1, BATCH))


def loss_of(network: ReferenceNetwork, frames: Frames, batch: np.ndarray, draws: torch.Generator) -> torch.Tensor:
    """Return the mean squared error of the flow's velocity, over the actions of a batch's episodes.

    Times are drawn as for π0 (arXiv 2410.24164), more of them near the noise.
    """
    index, horizon = torch.from_numpy(batch), network.sizes.horizon
    rows = index[:, None] + torch.arange(horizon)
    there = (rows < frames.end[index][:, None]).float()[..., None].repeat(DRAWS, 1, 1)
    actions = frames.action[rows.clamp(max=len(frames.action) - 1)].repeat(DRAWS, 1, 1)
    noise = torch.randn(actions.shape, generator=draws)
    times = 1 - 0.999 * torch.rand(len(actions), generator=draws) ** 1.5
    noisy = times[:, None, None] * noise + (1 - times)[:, None, None] * actions
    images = pixels(torch.from_numpy(frames.images[batch])).unbind(1)
    with torch.autocast("cpu", torch.bfloat16):
        context = network.encode(frames.tokens[index], frames.state[index], *images).repeat(DRAWS, 1)
        velocity = network.velocity(context, noisy, times)
    return ((velocity.float() - (noise - actions)) ** 2 * there).sum() / there.sum() / actions.shape[-1]


def fit(checkpoint: Checkpoint, frames: Frames, steps: int, seed: int, kept: Path) -> ReferenceNetwork:
    """Return the network after so many steps, from the state in the file `kept` if there is one."""
    torch.manual_seed(seed)
    network = ReferenceNetwork(checkpoint.sizes)
    average = copy.deepcopy(network)
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY, betas=(0.9, 0.99))
    first = 0
    if kept.is_file():
        state = torch.load(kept, weights_only=True)
        network.load_state_dict(state["network"])
        average.load_state_dict(state["average"])
        optimizer.load_state_dict(state["optimizer"])
        first = state["step"]
        typer.echo(f"continues after step {first}")
    begun, losses = time.monotonic(), list[float]()
    own, mean = list(network.parameters()), list(average.parameters())
    for step, batch in zip(range(steps), batches(len(frames.state), seed), strict=False):
        if step < first:
            continue
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1.0, (step + 1) / WARM_UP) * 0.5 * (1 + math.cos(math.pi * step / steps))
        loss = loss_of(network, frames, batch, torch.Generator().manual_seed(seed * 2**32 + step))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(own, CLIP)
        optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(mean, own, 1 - min(AVERAGE, (1 + step) / (10 + step)))
        losses.append(loss.item())
        done = step + 1
        if done % SHOWN_EVERY == 0 or done == steps:
            rate = (done - first) * BATCH / (time.monotonic() - begun)
            typer.echo(f"step {done} of {steps}: loss {np.mean(losses[-SHOWN_EVERY:]):.4f}, {rate:.0f} frames/s")
        if done % KEEP_EVERY == 0 and done < steps:
            state = {"network": network.state_dict(), "average": average.state_dict(),
                     "optimizer": optimizer.state_dict(), "step": done}  # fmt: skip
            torch.save(state, kept.with_suffix(".part"))
            os.replace(kept.with_suffix(".part"), kept)
    return average


def save(checkpoint: Checkpoint, network: ReferenceNetwork, folder: Path) -> None:
    """Write a checkpoint."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CONFIG).write_text(checkpoint.model_dump_json(indent=1, exclude_none=True) + "\n")
    with (folder / WEIGHTS).open("wb") as file:
        write_values(file, {name: value.numpy() for name, value in network.state_dict().items()})


def main(
    data: Annotated[Path, typer.Argument(help="Folder with a LeRobotDataset for each robot.")],
    out: Annotated[Path, typer.Argument(help="Folder of the checkpoint.")],
    cameras: Annotated[list[str], typer.Option(help="ROBOT=SCENE,WRIST: the robot's names of the cameras.")],
    steps: Annotated[int, typer.Option(min=1, help=f"Of {BATCH} frames each.")] = 12000,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    threads: Annotated[int, typer.Option(min=1, help="Others round differently.")] = 2,
    work: Annotated[Path, typer.Option(help="Folder for decoded images and the state of the training.")] = Path(
        "runs/reference/train"
    ),
) -> None:
    """Train, and write the checkpoint."""
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(True)
    work.mkdir(parents=True, exist_ok=True)
    named = {robot: dict(zip(CAMERAS, names.split(","), strict=True)) for robot, _, names in
             (one.partition("=") for one in cameras)}  # fmt: skip
    checkpoint, frames = read(data, named, work / "images.bin")
    typer.echo(f"{len(frames.state)} frames of {len(named)} robots, {len(checkpoint.words)} words")
    save(checkpoint, fit(checkpoint, frames, steps, seed, work / "state.pt"), out)


if __name__ == "__main__":
    typer.run(main)
