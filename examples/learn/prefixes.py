"""Continue the training of LeRobot's SmolVLA so that its chunks begin with given rows.

    python examples/learn/prefixes.py CHECKPOINT DATASET OUT --longest 4 --steps 2000

CHECKPOINT is a folder that `lerobot-train --policy.type=smolvla` wrote, and DATASET the folder of
its dataset, which `vlagents-ray export --to lerobot` or a recording wrote. Serve OUT with
`longest_prefix: 4`, and measure it with and without real-time chunking before you use it.

In half of the chunks, the given rows have errors, and the labels return to the demonstrated path.
With the demonstrated rows alone, a policy learns to copy the plan that it is given.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

from vlagents_ray.columns import Columns
from vlagents_ray.dataset_contract import INFO, DatasetContract
from vlagents_ray.policies.prefixes import with_errors
from vlagents_ray_models.lerobot.samplers import accept_times_of_rows

ERRONEOUS = 0.5  # share of the chunks whose given rows have errors
# The learning rate, as a share of the rate of the first training. A higher rate costs the rows at
# the end of a chunk.
GENTLE = 1 / 3
CLIP = 10.0  # largest norm of a gradient, as in `lerobot-train`


def chunks_of(folder: Path, rows: int) -> LeRobotDataset:
    """Return a dataset whose frames have chunks of actions."""
    fps = LeRobotDataset("local/data", root=folder).fps
    times = {"action": [row / fps for row in range(rows)]}
    return LeRobotDataset("local/data", root=folder, delta_timestamps=times)


def columns_of(dataset: LeRobotDataset) -> Columns:
    """Return the meaning of the columns of actions, which the dataset's contract declares."""
    description = dataset.meta.info.get(INFO)
    dim = dataset.meta.features["action"]["shape"][0]
    if description is not None:
        columns = Columns.from_spec(DatasetContract.from_json(description).contract.action, dim)
        if columns.is_known:
            return columns
    raise typer.BadParameter(
        f"{dataset.root}: expected a dataset that declares which columns of its actions are "
        "relative, got none; record or export it with vlagents-ray, from an environment or arm "
        "whose contract has `delta`"
    )


class Prefixes:
    """Draws the given rows of training chunks."""

    def __init__(self, dataset: LeRobotDataset, longest: int, seed: int) -> None:
        columns = columns_of(dataset)
        self.longest, self.draws = longest, torch.Generator().manual_seed(seed)
        is_relative = torch.zeros(columns.dim, dtype=torch.bool)
        is_relative[list(columns.relative)] = True
        # A wrong command of a gripper cannot be undone, so that grippers get no errors.
        is_target = ~is_relative
        is_target[list(columns.grippers)] = False
        self.is_relative, self.is_target = is_relative, is_target
        statistics = dataset.meta.stats["action"]
        self.low = torch.as_tensor(statistics["min"]).float()
        self.high = torch.as_tensor(statistics["max"]).float()

    def draw(self, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return chunks (B, H, D), and whether each row is given, (B, H, 1).

        Args:
            actions: Demonstrated chunks, (B, H, D), in the dataset's units.
        """
        count = len(actions)
        lengths = torch.randint(0, self.longest + 1, (count,), generator=self.draws)
        erroneous = torch.rand(count, generator=self.draws) < ERRONEOUS
        changed = with_errors(
            actions,
            lengths * erroneous,
            self.is_relative,
            self.draws,
            targets=self.is_target,
            low=self.low,
            high=self.high,
        )
        is_given = torch.arange(actions.shape[1])[None, :, None] < lengths[:, None, None]
        return changed, is_given


def loss_of(policy: SmolVLAPolicy, batch: dict[str, Any], is_given: torch.Tensor) -> torch.Tensor:
    """Return SmolVLA's loss over the rows that are neither given nor padding.

    Args:
        policy: The policy, whose `embed_suffix` accepts a time for each row.
        batch: The results of the policy's pre-processor.
        is_given: Whether each row is given, (B, H, 1). The network reads these rows as actions, at
            flow time 0.
    """
    model, actions = policy.model, policy.prepare_action(batch)
    embed = model.embed_suffix

    def embed_with_given(noisy: torch.Tensor, times: torch.Tensor) -> Any:
        times_of_rows = torch.where(is_given[..., 0], 0.0, times[:, None])
        return embed(torch.where(is_given, actions, noisy), times_of_rows)

    images, masks = policy.prepare_images(batch)
    tokens = batch["observation.language.tokens"], batch["observation.language.attention_mask"]
    model.embed_suffix = embed_with_given
    try:
        losses = model.forward(images, masks, *tokens, policy.prepare_state(batch), actions)
    finally:
        model.embed_suffix = embed

    dim = batch["action"].shape[-1]
    is_learned = ~is_given & ~batch["action_is_pad"][..., None]
    return (losses[..., :dim] * is_learned).sum() / (is_learned.sum() * dim).clamp(min=1)


def batches(dataset: LeRobotDataset, size: int, seed: int) -> Iterator[dict[str, Any]]:
    """Return batches of the dataset in random order, again and again."""
    draws = torch.Generator().manual_seed(seed)
    while True:
        yield from torch.utils.data.DataLoader(
            dataset, batch_size=size, shuffle=True, drop_last=len(dataset) > size, generator=draws
        )


def main(
    checkpoint: Annotated[Path, typer.Argument(help="Folder of a trained SmolVLA.")],
    data: Annotated[Path, typer.Argument(metavar="DATASET", help="Folder of its dataset.")],
    out: Annotated[Path, typer.Argument(help="Folder of the new checkpoint.")],
    longest: Annotated[int, typer.Option(min=1, help="Largest number of given rows.")] = 4,
    steps: Annotated[int, typer.Option(min=1, help="Number of steps.")] = 2000,
    batch_size: Annotated[int, typer.Option(min=1, help="Chunks of a step.")] = 32,
    device: Annotated[str, typer.Option(help="Device of the training.")] = "cpu",
    seed: int = 0,
) -> None:
    """Train a SmolVLA to begin its chunks with given rows."""
    settings = PreTrainedConfig.from_pretrained(checkpoint)
    if settings.type != "smolvla":
        raise typer.BadParameter(f"expected a SmolVLA, got LeRobot's {settings.type!r}")
    if longest >= settings.chunk_size:
        raise typer.BadParameter(
            f"--longest: expected less than the chunk's {settings.chunk_size} rows, got {longest}"
        )
    settings.device = device
    policy = SmolVLAPolicy.from_pretrained(checkpoint, config=settings).train()
    accept_times_of_rows(policy.model)
    preprocess, _ = make_pre_post_processors(
        settings,
        pretrained_path=str(checkpoint),
        preprocessor_overrides={"device_processor": {"device": device}},
    )

    dataset = chunks_of(data, settings.chunk_size)
    prefixes = Prefixes(dataset, longest, seed)

    torch.manual_seed(seed)
    parameters = [value for value in policy.parameters() if value.requires_grad]
    optimizer = torch.optim.AdamW(parameters, lr=GENTLE * settings.optimizer_lr)
    for step, batch in zip(range(steps), batches(dataset, batch_size, seed), strict=False):
        actions, is_given = prefixes.draw(batch["action"])
        loss = loss_of(policy, preprocess({**batch, "action": actions}), is_given.to(device))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, CLIP)
        optimizer.step()
        if step % 100 == 0 or step == steps - 1:
            print(f"step {step + 1}: loss {loss.item():.4f}", flush=True)

    # The processors are those of the first training.
    shutil.copytree(checkpoint, out)
    policy.save_pretrained(out)


if __name__ == "__main__":
    typer.run(main)
