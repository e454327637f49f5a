"""Train the reference policy on LeRobotDatasets, one for each robot.

Options: `python examples/reference/train.py --help`.

An interrupted run continues from its last saved state, and ends with the same weights, since each
batch and its noise follow from the seed and the number of the step. A second run also ends with the
same weights, on the same processor, with the same version of torch and the same number of threads.
"""

from __future__ import annotations

import copy
import json
import math
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from torch.nn.functional import smooth_l1_loss

from vlagents_ray.columns import Columns
from vlagents_ray.datasets.episode import INTERVENTION_COLUMN
from vlagents_ray.policies.base.model_inputs import resize_with_pad, state_vector
from vlagents_ray.policies.prefixes import with_errors
from vlagents_ray.policies.reference.checkpoint import (
    CAMERAS,
    CONFIG,
    WEIGHTS,
    Checkpoint,
    Embodiment,
    NetworkSizes,
    normalised,
    pixels,
    read_checkpoint,
    words_of,
)
from vlagents_ray.policies.reference.network import ReferenceNetwork, read_network
from vlagents_ray.ray_tools.git_state import code_in
from vlagents_ray.recorded_dataset import Names, RecordedDataset
from vlagents_ray.weights.safetensors import write_values

BATCH = 256  # frames per batch
# The number of times that a frame's context is used in a step, each time with other noise, which
# takes little time.
DRAWS = 4
# Learning rate and weight decay of AdamW without a start checkpoint, and largest norm of a
# gradient.
RATE, DECAY, CLIP = 3e-3, 0.01, 1.0
WARM_UP = 200  # number of steps after which the learning rate falls as a cosine
# The weight of the error of object positions. This error teaches the network early which words
# belong to which objects in images.
OBJECTS = 1.0
AVERAGE = 0.999  # decay per step of the average of the weights, which is saved
# With `--delays`, the share of the chunks whose given rows have errors.
ERRONEOUS = 0.5
# The modules that are trained with `--delays`. The images are encoded as before.
HEAD = ("context", "noisy", "when", "why", "blocks", "result", "given")
MADE = "training.json"
KEEP_EVERY = 500  # number of steps between two saved states
SHOWN_EVERY = 100  # number of steps between two lines of the log


def computing_dtype() -> torch.dtype:
    """Return the type with which a step computes. The optimizer always uses float32.

    It is bfloat16 on a processor with AVX-512. On a processor with only AVX2, PyTorch took 57 times
    as long for a product of matrices in bfloat16 as in float32 (512 x 256 by 256 x 256).
    """
    has_bfloat16 = torch.backends.cpu.get_cpu_capability() == "AVX512"
    return torch.bfloat16 if has_bfloat16 else torch.float32


@dataclass(frozen=True)
class Frames:
    """The N frames of all datasets, in the order of robots and episodes.

    M of them are used for training.
    """

    images: np.ndarray  # (M, cameras, S, S, 3) uint8
    place: torch.Tensor  # index of each training frame among all N frames, (M,) int64
    state: torch.Tensor  # (N, S) in the network's units
    # The positions of objects with mean 0 and variance 1, (N, O); NaN where a robot's dataset has
    # none.
    objects: torch.Tensor
    action: torch.Tensor  # (N, D)
    tokens: torch.Tensor  # (N, L)
    # The number of rows from each frame on that the policy had planned before, at the end of which
    # the expert took over; -1 if the training may draw any number, since the expert drives at the
    # frame, (N,) int64.
    given: torch.Tensor
    # The index of the first frame after each frame's episode, or after the expert's part of it,
    # (N,) int64.
    end: torch.Tensor
    # Whether each value of a frame's action is relative, (N, D) bool.
    relative: torch.Tensor
    # With `--delays`, the encoded training frames, (M, F) float16.
    features: torch.Tensor | None = None


def read(
    data: Path,
    cameras: dict[str, dict[str, str]],
    kept: Path,
    every: int = 1,
    start: Checkpoint | None = None,
    delays: int = 0,
) -> tuple[Checkpoint, Frames]:
    """Read the dataset of each robot in a folder.

    From a dataset with interventions, only the interventions are used for training, and with
    `delays` also the frames up to this number of rows before an intervention.

    Args:
        data: The folder, with a dataset for each robot.
        cameras: For each robot, the network's camera -> the robot's camera.
        kept: A file for the decoded images, which may be larger than the memory.
        every: One of this number of consecutive frames is used for training, since neighbouring
            frames are nearly the same.
        start: The checkpoint that is trained further. Its words and units are kept.
        delays: The largest number of given rows.

    Returns:
        The description of the checkpoint, and the frames.
    """
    sizes = NetworkSizes(words=1)
    texts, ends, places = list[str](), list[int](), list[int]()
    given, relative = list[int](), list[np.ndarray]()
    states, objects, actions = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    robots: dict[str, Embodiment] = {}
    with kept.open("wb") as file:
        for robot, names in cameras.items():
            dataset, own, around = (
                RecordedDataset(data / robot),
                list[np.ndarray](),
                list[np.ndarray](),
            )
            contract = dataset.contract
            if contract is None:
                raise typer.BadParameter(
                    f"{data / robot}: was not exported by this project: its info has no contract"
                )
            parts = list(contract.state) if start is None else start.embodiments[robot].state
            corrected = INTERVENTION_COLUMN in dataset.features
            for session in dataset.sessions():
                [episode] = session.episodes
                begun = len(texts)
                steps = list(dataset.steps(episode, Names(), None))
                waits, stops = corrections([step.intervention or not corrected for step in steps])
                for step in steps:
                    if step.frame % every == 0 and 0 <= waits[step.frame] <= delays:
                        seen = (step.obs.cameras[names[name]] for name in CAMERAS)
                        file.write(
                            np.stack(
                                [resize_with_pad(one, sizes.side, sizes.side) for one in seen]
                            ).tobytes()
                        )
                        places.append(begun + step.frame)
                    own.append(state_vector(step.obs, parts))
                    around.append(state_vector(step.obs, contract.environment))
                    actions.append(step.expected[0])
                given += [wait or -1 for wait in waits]
                ends += [begun + stop for stop in stops]
                texts += [episode.instruction] * episode.length
            found, things = np.stack(own), np.stack(around)
            robots[robot] = (
                start.embodiments[robot]
                if start is not None
                else Embodiment(
                    cameras=names,
                    state=parts,
                    state_mean=found.mean(0).tolist(),
                    state_std=found.std(0).tolist(),
                    action=contract.contract.to_json()["action"],
                )
            )
            states.append(normalised(robots[robot], found, sizes.state))
            columns = Columns.from_spec(contract.contract.action, len(actions[-1]))
            is_relative = np.isin(np.arange(len(actions[-1])), columns.relative)
            relative += [is_relative] * len(found)
            objects.append((things - things.mean(0)) / np.maximum(things.std(0), 1e-2))
    words = sorted({word for text in set(texts) for word in words_of(text)})
    sizes = sizes.model_copy(update={"words": len(words)})
    checkpoint = start or Checkpoint(sizes=sizes, words=words, embodiments=robots)
    images = np.memmap(
        kept, np.uint8, "r", shape=(len(places), len(CAMERAS), sizes.side, sizes.side, 3)
    )
    known = {text: checkpoint.tokens(text) for text in set(texts)}
    widest = max(1, *(one.shape[1] for one in objects))
    filled = [
        np.pad(one, ((0, 0), (0, widest - one.shape[1])), constant_values=np.nan) for one in objects
    ]
    return checkpoint, Frames(
        images,
        torch.tensor(places),
        torch.from_numpy(np.concatenate(states)),
        torch.from_numpy(np.concatenate(filled).astype(np.float32)),
        torch.from_numpy(np.stack(actions)),
        torch.from_numpy(np.stack([known[text] for text in texts])),
        torch.tensor(given),
        torch.tensor(ends),
        torch.from_numpy(np.stack(relative)),
    )


def corrections(led: Sequence[bool]) -> tuple[list[int], list[int]]:
    """Return for each frame of an episode the number of frames until the expert drives, and the
    frame at which the expert then stops.

    Args:
        led: Whether the expert drives at each frame.

    Returns:
        The numbers of frames, -1 where the expert drives at no later frame; and the frames.
    """
    waits, stops = [0] * len(led), [0] * len(led)
    wait, stop = -1, len(led)
    for frame in reversed(range(len(led))):
        if led[frame]:
            if wait != 0:
                stop = frame + 1
            wait = 0
        elif wait >= 0:
            wait += 1
        waits[frame], stops[frame] = wait, stop
    return waits, stops


def batches(frames: int, seed: int) -> Iterator[np.ndarray]:
    """Yield the frames of each step, sorted, since they are read from a file.

    All frames are used once before any frame is used again.
    """
    for epoch in range(10**9):
        order = np.random.default_rng([seed, epoch]).permutation(frames)
        yield from (
            np.sort(order[at : at + BATCH]) for at in range(0, max(frames - BATCH, 0) + 1, BATCH)
        )


class Training(torch.nn.Module):  # type: ignore[misc]  # torch's own types are not read
    """The network, with an additional prediction of object positions from its context, which is
    only used in training.
    """

    def __init__(self, sizes: NetworkSizes, objects: int) -> None:
        super().__init__()
        self.network = ReferenceNetwork(sizes)
        self.guess = torch.nn.Linear(2 * sizes.head, objects)

    def forward(
        self,
        features: torch.Tensor,
        noisy: torch.Tensor,
        times: torch.Tensor,
        frozen: torch.Tensor | None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        context = self.network.context_of(features)
        repeated = context.repeat(DRAWS, 1)
        if frozen is not None:
            repeated = self.network.with_prefixes(repeated, noisy, frozen)
        return self.network.velocity(repeated, noisy, times), self.guess(context)


def encoded(network: ReferenceNetwork, frames: Frames, batch: np.ndarray) -> torch.Tensor:
    """Return the features of training frames, (B, F), in the type of the network."""
    index, dtype = frames.place[batch], next(network.parameters()).dtype
    images = pixels(torch.from_numpy(frames.images[batch])).to(dtype).unbind(1)
    features: torch.Tensor = network.features(
        frames.tokens[index], frames.state[index].to(dtype), *images
    )
    return features


def loss_of(
    training: Training, frames: Frames, batch: np.ndarray, draws: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the mean squared error of the flow's velocity over a batch, and the error of the
    object positions.

    Flow times are drawn as for π0 (arXiv 2410.24164), more often near the noise.

    Args:
        training: The network with the additional prediction, in any floating-point type.
        frames: All frames.
        batch: The indices of the batch's frames among the training frames, (B,).
        draws: The generator of noise and times.
    """
    index, sizes = frames.place[batch], training.network.sizes
    horizon = sizes.horizon
    rows = index[:, None] + torch.arange(horizon)
    there = (rows < frames.end[index][:, None]).float()[..., None].repeat(DRAWS, 1, 1)
    actions = frames.action[rows.clamp(max=len(frames.action) - 1)].repeat(DRAWS, 1, 1)
    noise = torch.randn(actions.shape, generator=draws)
    times = 1 - 0.999 * torch.rand(len(actions), generator=draws) ** 1.5
    frozen = None
    if sizes.longest_prefix:
        given = frames.given[index].repeat(DRAWS)
        drawn = torch.randint(0, sizes.longest_prefix + 1, given.shape, generator=draws)
        lengths = torch.where(given < 0, drawn, given)
        has_errors = (torch.rand(given.shape, generator=draws) < ERRONEOUS) & (given < 0)
        relative = frames.relative[index].repeat(DRAWS, 1)
        actions = with_errors(actions, lengths * has_errors, relative, draws)
        frozen = (torch.arange(horizon) < lengths[:, None]).float()[..., None]
        there = there * (1 - frozen)

    noisy = times[:, None, None] * noise + (1 - times)[:, None, None] * actions
    if frozen is not None:
        noisy = frozen * actions + (1 - frozen) * noisy
    dtype = next(training.parameters()).dtype
    if frames.features is None:
        features = encoded(training.network, frames, batch)
    else:
        features = frames.features[batch].to(dtype)
    velocity, guessed = training(features, noisy.to(dtype), times, frozen)
    objects, flow = frames.objects[index], (velocity.float() - (noise - actions)) ** 2 * there
    known = ~objects.isnan()
    off = smooth_l1_loss(guessed.float()[known], objects[known]) if known.any() else torch.zeros(())
    return flow.sum() / there.sum() / actions.shape[-1], off


def trained_values(training: Training) -> list[torch.nn.Parameter]:
    return [value for value in training.parameters() if value.requires_grad]


def fit(
    checkpoint: Checkpoint,
    frames: Frames,
    steps: int,
    seed: int,
    kept: Path,
    threads: int = 1,
    rate: float = RATE,
    start: Path | None = None,
) -> ReferenceNetwork:
    """Return the network after `steps` steps.

    The training continues from the state in the file `kept` if there is one, otherwise from
    `start`. Each thread computes a part of a batch, which is 1.4 times as fast as operations with
    several threads. With a `longest_prefix`, only the modules of `HEAD` are trained, so that each
    frame is encoded once.
    """
    torch.manual_seed(seed)
    training = Training(checkpoint.sizes, frames.objects.shape[1])
    if start is not None:
        begun = read_network(read_checkpoint(start).sizes, start)
        # A network without prefixes has no input for given rows.
        training.network.load_state_dict(training.network.state_dict() | begun.state_dict())
    if checkpoint.sizes.longest_prefix:
        for name, value in training.network.named_parameters():
            value.requires_grad_(name.partition(".")[0] in HEAD)
    if checkpoint.sizes.longest_prefix and frames.features is None:
        with torch.no_grad():
            every_frame = np.arange(len(frames.place))
            parts = [
                encoded(training.network, frames, part).half()
                for part in np.array_split(every_frame, -(-len(every_frame) // BATCH))
            ]
        frames = replace(frames, features=torch.cat(parts))
    average = copy.deepcopy(training)
    own, mean = trained_values(training), trained_values(average)
    copies = [copy.deepcopy(training).to(computing_dtype()) for _ in range(threads)]
    optimizer = torch.optim.AdamW(own, lr=rate, weight_decay=DECAY, betas=(0.9, 0.99), fused=True)
    first = 0
    if kept.is_file():
        state = torch.load(kept, weights_only=True)
        training.load_state_dict(state["training"])
        average.load_state_dict(state["average"])
        optimizer.load_state_dict(state["optimizer"])
        first = state["step"]
        typer.echo(f"continues after step {first}")

    def gradients(
        part: tuple[int, int, np.ndarray],
    ) -> tuple[tuple[float, float], tuple[torch.Tensor, ...]]:
        step, number, rows = part
        low = trained_values(copies[number])
        with torch.no_grad():
            torch._foreach_copy_(low, own)
        draws = torch.Generator().manual_seed((seed * 2**32 + step) * threads + number)
        flow, off = loss_of(copies[number], frames, rows, draws)
        return (flow.item(), off.item()), torch.autograd.grad(
            flow + OBJECTS * off, low, materialize_grads=True
        )

    pool = ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))
    began, losses = time.monotonic(), list[tuple[float, float]]()
    for step, batch in zip(range(steps), batches(len(frames.place), seed), strict=False):
        if step < first:
            continue
        for group in optimizer.param_groups:
            group["lr"] = (
                rate * min(1.0, (step + 1) / WARM_UP) * 0.5 * (1 + math.cos(math.pi * step / steps))
            )
        parts = [(step, number, part) for number, part in enumerate(np.array_split(batch, threads))]
        found = list(pool.map(gradients, parts))
        for number, value in enumerate(own):
            value.grad = torch.stack([grads[number] for _, grads in found]).float().mean(0)
        torch.nn.utils.clip_grad_norm_(own, CLIP)
        optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(mean, own, 1 - min(AVERAGE, (1 + step) / (10 + step)))
        losses += [loss for loss, _ in found]
        done = step + 1
        if done % SHOWN_EVERY == 0 or done == steps:
            speed = (done - first) * BATCH / (time.monotonic() - began)
            loss, error = np.mean(losses[-threads * SHOWN_EVERY :], axis=0)
            typer.echo(
                f"step {done} of {steps}: loss {loss:.4f}, objects {error:.4f}, {speed:.0f} "
                "frames/s"
            )
        if done % KEEP_EVERY == 0 and done < steps:
            state = {"training": training.state_dict(), "average": average.state_dict(),
                     "optimizer": optimizer.state_dict(), "step": done}  # fmt: skip
            torch.save(state, kept.with_suffix(".part"))
            os.replace(kept.with_suffix(".part"), kept)
    return average.network


def for_delays(checkpoint: Checkpoint, robots: Sequence[str], delays: int) -> Checkpoint:
    """Return the description of a checkpoint whose head is trained with given rows of `robots`."""
    return checkpoint.model_copy(
        update={
            "sizes": checkpoint.sizes.model_copy(update={"longest_prefix": delays}),
            "embodiments": {robot: checkpoint.embodiments[robot] for robot in robots},
        }
    )


def save(
    checkpoint: Checkpoint, network: ReferenceNetwork, folder: Path, trained: dict[str, Any]
) -> None:
    """Write a checkpoint. `trained` describes how it was made, for the model card."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MADE).write_text(json.dumps(trained, indent=1) + "\n")
    (folder / CONFIG).write_text(checkpoint.model_dump_json(indent=1, exclude_none=True) + "\n")
    with (folder / WEIGHTS).open("wb") as file:
        write_values(file, {name: value.numpy() for name, value in network.state_dict().items()})


def main(
    data: Annotated[Path, typer.Argument(help="Folder with a LeRobotDataset for each robot.")],
    out: Annotated[Path, typer.Argument(help="Folder of the checkpoint.")],
    cameras: Annotated[
        list[str], typer.Option(help="ROBOT=SCENE,WRIST: the robot's names of the cameras.")
    ],
    steps: Annotated[
        int, typer.Option(min=1, help=f"Number of steps with {BATCH} frames each.")
    ] = 11000,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    every: Annotated[
        int, typer.Option(min=1, help="Use one of this number of consecutive frames of an episode.")
    ] = 1,
    threads: Annotated[int, typer.Option(min=1, help="Others round differently.")] = 2,
    start: Annotated[
        Path | None,
        typer.Option(help="Checkpoint that is trained further; default: a new network."),
    ] = None,
    rate: Annotated[float, typer.Option(help="Largest learning rate.")] = RATE,
    delays: Annotated[
        int,
        typer.Option(
            min=0,
            max=NetworkSizes(words=1).horizon - 1,
            help="Largest number of rows of the executed plan with which a chunk begins. Trains "
            "the head of START alone, and keeps only the robots of DATA.",
        ),
    ] = 0,
    work: Annotated[
        Path, typer.Option(help="Folder for decoded images and the state of the training.")
    ] = Path("runs/reference/train"),
) -> None:
    """Train, and write the checkpoint."""
    if delays and start is None:
        raise typer.BadParameter("--delays: expected --start, a checkpoint whose head is trained")
    torch.use_deterministic_algorithms(True)
    work.mkdir(parents=True, exist_ok=True)
    named = {robot: dict(zip(CAMERAS, names.split(","), strict=True)) for robot, _, names in
             (one.partition("=") for one in cameras)}  # fmt: skip
    begun = None if start is None else read_checkpoint(start)
    checkpoint, frames = read(data, named, work / "images.bin", every, begun, delays)
    if delays:
        checkpoint = for_delays(checkpoint, list(named), delays)
    typer.echo(
        f"{len(frames.place)} of {len(frames.state)} frames of {len(named)} robots, "
        f"{len(checkpoint.words)} words"
    )
    network = fit(checkpoint, frames, steps, seed, work / "state.pt", threads, rate, start)
    infos = {robot: RecordedDataset(data / robot).info for robot in named}
    code = code_in(Path(__file__).parent)
    trained = {
        "robots": {
            robot: {"episodes": info["total_episodes"], "frames": info["total_frames"]}
            for robot, info in infos.items()
        },
        "trained_frames": len(frames.place),
        "steps": steps,
        "batch": BATCH,
        "seed": seed,
        "threads": threads,
        "processor": torch.backends.cpu.get_cpu_capability(),
        "torch": torch.__version__,
        "parameters": sum(value.numel() for value in network.parameters()),
        **({"delays": delays} if delays else {}),
        "commit": code and code.commit,
    }
    if start is not None:
        trained["start"] = json.loads((start / MADE).read_text())
    save(checkpoint, network, out, trained)


if __name__ == "__main__":
    typer.run(main)
