"""The reference policy: a small vision-language-action model that is trained from nothing on two cores.

Its weights, card and training are in the folder `reference/` of a checkout. It is also the model of a family for
authors of others: a network, its settings, and a `ModelPolicy` around both.

A checkpoint is a folder with `model.safetensors` and `config.json`, see `Checkpoint`.
"""

# mypy: disable-error-code="misc"
# torch's own types are not read, so that its classes are of type Any, which mypy would not have subclassed.

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from pydantic import BaseModel, Field, ValidationError
from torch import Tensor, nn
from torch.nn.functional import gelu, normalize, silu

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidObservation, VLAgentsError
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row, shared_frames
from vlagents_ray.policies.base.accelerator import torch_device, torch_dtype
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.policies.base.config import NoiseLevel
from vlagents_ray.policies.base.model_inputs import (
    camera_images,
    camera_specs,
    choose_cameras,
    needs_gripper,
    resize_with_pad,
    state_specs,
    state_vector,
)
from vlagents_ray.policies.base.staging import StagedRow, Staging
from vlagents_ray.policies.flow import OFFERED, Change, FlowPasses, Guide, RandomSteps
from vlagents_ray.weights.safetensors import read_values

CAMERAS = ("scene", "wrist")  # the model's, in the order of its image encoders
CONFIG, WEIGHTS = "config.json", "model.safetensors"
_TIMES = 32  # frequencies of the flow's time, from 1 to 1000 rad
_SHARPNESS = 12.0  # of the attention to images: the score of a token that is exactly what a query asks for
_LEAST_STD = 1e-2  # of a number of the state, so that one that never changed in training stays near zero


class NetworkSizes(BaseModel, extra="forbid", frozen=True):
    """The sizes of a network; by default 3.9 million parameters."""

    words: int  # of the vocabulary
    longest: int = 16  # words of an instruction
    side: int = 64  # px of an image
    patch: int = 12  # px, side of what an image token sees
    stride: int = 8  # px between two tokens
    state: int = 8  # numbers; a robot with fewer has zeros after them
    horizon: int = 8  # actions of a chunk
    action: int = 4  # numbers of an action
    token_width: int = 96
    queries: int = 16
    width: int = 128  # of a query
    looks: int = 2  # times that each query looks at the images
    head: int = 256  # width of the flow's network
    blocks: int = 3  # of the flow's network


class Embodiment(BaseModel, extra="forbid", frozen=True):
    """What differs between the robots of a checkpoint."""

    cameras: dict[str, str]  # of CAMERAS -> the robot's
    state: list[str]  # parts of its proprioception, in order
    state_mean: list[float]
    state_std: list[float]
    action: dict[str, Any]  # the `ActionSpec` of its actions, which are in [-1, 1]
    execute: int | None = None  # rows of a chunk that are executed, as far as it was trained to be


def words_of(instruction: str) -> list[str]:
    return re.findall(r"[\w-]+", instruction.lower())


class Checkpoint(BaseModel, extra="forbid", frozen=True):
    """The file `config.json` of a checkpoint."""

    sizes: NetworkSizes
    words: list[str]  # of instructions; the first one has the token 1, as 0 is padding
    embodiments: dict[str, Embodiment]

    def tokens(self, instruction: str) -> np.ndarray:
        """Return the tokens of an instruction, (longest,) int64, 0 after its last word.

        Raises:
            InvalidObservation: It has a word that the training did not have, or too many.
        """
        said = words_of(instruction)
        if unknown := [word for word in said if word not in self.words]:
            raise InvalidObservation(f"instruction: got {unknown[0]!r} in {instruction!r}, want words of {self.words}")
        if not 0 < len(said) <= self.sizes.longest:
            raise InvalidObservation(f"instruction: got {len(said)} words, want 1 to {self.sizes.longest}")
        tokens = np.zeros(self.sizes.longest, np.int64)
        tokens[: len(said)] = [self.words.index(word) + 1 for word in said]
        return tokens


def _mlp(width: int, out: int | None = None) -> nn.Sequential:
    return nn.Sequential(
        nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, out or width)
    )


class _Eye(nn.Module):
    """Turns the images of a camera into tokens, and those into keys and values for each look.

    Patches are normalised before and after their projection (arXiv 2302.01327), as they differ by few pixels.
    """

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        width, pixels = sizes.token_width, 3 * sizes.patch**2
        self.cut = nn.Unfold(sizes.patch, padding=(sizes.patch - sizes.stride) // 2, stride=sizes.stride)
        self.patches = nn.Sequential(nn.LayerNorm(pixels), nn.Linear(pixels, width), nn.LayerNorm(width))
        self.places = nn.Parameter(0.02 * torch.randn((sizes.side // sizes.stride) ** 2, width))
        self.mix = _mlp(width)
        self.keys = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * sizes.looks * width))

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        tokens = self.patches(self.cut(images).transpose(1, 2)) + self.places
        tokens = tokens + self.mix(tokens)
        return self.keys(tokens).split(tokens.shape[-1], -1)  # type: ignore[no-any-return]


class _Look(nn.Module):
    """Lets each query attend to the tokens of all cameras, and learn what is there and where."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.ask = nn.Sequential(nn.LayerNorm(sizes.width), nn.Linear(sizes.width, len(CAMERAS) * sizes.token_width))
        self.answer = nn.Linear(len(CAMERAS) * (sizes.token_width + 2), sizes.width)
        self.among = nn.Linear(sizes.queries, sizes.queries)
        self.mix = _mlp(sizes.width)

    def forward(self, queries: Tensor, seen: Sequence[tuple[Tensor, Tensor]], grid: Tensor) -> Tensor:
        found = []
        for asked, (keys, values) in zip(self.ask(queries).chunk(len(seen), -1), seen, strict=True):
            scores = (_SHARPNESS * normalize(asked, dim=-1) @ normalize(keys, dim=-1).transpose(1, 2)).softmax(-1)
            found += [scores @ values, scores @ grid.to(scores.dtype)]
        queries = queries + self.answer(torch.cat(found, -1))
        queries = queries + self.among(queries.transpose(1, 2)).transpose(1, 2)
        return queries + self.mix(queries)


class _Block(nn.Module):
    """A layer of the flow's network, scaled and shifted by its condition."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.condition = nn.Linear(width, 2 * width)
        self.up, self.down = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, hidden: Tensor, condition: Tensor) -> Tensor:
        scale, shift = self.condition(condition).chunk(2, -1)
        return hidden + self.down(gelu(self.up(self.norm(hidden) * (1 + scale) + shift)))


class ReferenceNetwork(nn.Module):
    """Looks for what the instruction names, and turns noise into the actions towards it.

    Queries read the words, so that each stands for a thing or a deed that is named. They look at the images twice: a
    query's attention to a camera's tokens gives what it found, and its place. All of them and the robot's state make
    the context, from which a small network computes the velocity of the flow (arXiv 2210.02747).
    """

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.sizes, width = sizes, sizes.width
        self.words = nn.Embedding(sizes.words + 1, width)
        self.order = nn.Parameter(0.02 * torch.randn(sizes.longest, width))
        self.queries = nn.Parameter(0.5 * torch.randn(sizes.queries, width))
        self.read, self.understand = nn.Linear(width, 2 * width), _mlp(width)
        self.feel = nn.Sequential(nn.Linear(sizes.state, width), nn.GELU(), nn.Linear(width, width))
        self.eyes = nn.ModuleList(_Eye(sizes) for _ in CAMERAS)
        self.looks = nn.ModuleList(_Look(sizes) for _ in range(sizes.looks))
        self.context = nn.Linear(sizes.queries * width + sizes.state, 2 * sizes.head)
        self.noisy = nn.Linear(sizes.horizon * sizes.action, sizes.head)
        self.when = nn.Sequential(nn.Linear(2 * _TIMES, sizes.head), nn.SiLU(), nn.Linear(sizes.head, sizes.head))
        self.why = nn.Linear(2 * sizes.head, sizes.head)
        self.blocks = nn.ModuleList(_Block(sizes.head) for _ in range(sizes.blocks))
        self.result = nn.Linear(sizes.head, sizes.horizon * sizes.action)
        side = torch.linspace(-1, 1, sizes.side // sizes.stride)
        self.register_buffer("grid", torch.cartesian_prod(side, side).flip(-1), persistent=False)  # (tokens, 2): x, y
        self.register_buffer("rates", torch.logspace(0, 3, _TIMES), persistent=False)

    def encode(self, tokens: Tensor, state: Tensor, *images: Tensor) -> Tensor:
        """Return the context (P, 2 * head) of words (P, L) int64, states (P, S) and images (P, 3, S, S) in [-1, 1]."""
        words = self.words(tokens) + self.order
        keys, values = self.read(words).chunk(2, -1)
        scores = self.queries @ keys.transpose(1, 2) / math.sqrt(self.sizes.width)
        queries = self.queries + scores.masked_fill(tokens[:, None] == 0, -math.inf).softmax(-1) @ values
        queries = queries + self.understand(queries) + self.feel(state)[:, None]
        seen = [eye(image) for eye, image in zip(self.eyes, images, strict=True)]
        for number, look in enumerate(self.looks):
            queries = look(queries, [one[2 * number : 2 * number + 2] for one in seen], self.grid)
        return silu(self.context(torch.cat([queries.flatten(1), state], -1)))

    def velocity(self, context: Tensor, actions: Tensor, times: Tensor) -> Tensor:
        """Return the velocity, noise minus actions, of noisy actions (B, H, D) at times (B,), 1 being noise."""
        angles = times[:, None].float() * self.rates.float()
        when = torch.cat([angles.sin(), angles.cos()], -1).to(context.dtype)
        condition = silu(self.why(context) + self.when(when))
        hidden = self.noisy(actions.flatten(1))
        for block in self.blocks:
            hidden = block(hidden, condition)
        return self.result(hidden).unflatten(-1, actions.shape[1:])


class ReferencePasses(FlowPasses):
    """The passes of a `ReferenceNetwork`; actions stay in float32 between the steps."""

    def encode(self, tokens: Any, mask: Any, cameras: Any, state: Any, *images: Any) -> tuple[Any, Any]:
        return self.model.encode(tokens, state, *images), tokens

    def velocity(self, encoded: Any, seen: Any, state: Any, actions: Any, times: Any) -> Any:
        return self.model.velocity(encoded, actions.to(encoded.dtype), times).float()


class ReferenceConfig(ModelConfig):
    """Settings of the reference policy, in addition to those of all models."""

    embodiment: str | None = Field(
        default=None, description="the robot, as the checkpoint names it; unset: the only one that it has"
    )
    steps: int = Field(default=5, ge=1, description="steps of the flow")
    guidance: float = Field(default=5.0, gt=0, description="real-time chunking: largest weight of the old plan")
    noise_level: NoiseLevel = 0.0


@dataclass(frozen=True)
class LoadedReference:
    """The network, and what its checkpoint states."""

    network: ReferenceNetwork
    checkpoint: Checkpoint
    robot: Embodiment
    dtype: Any
    passes: ReferencePasses
    staging: Staging


class Reference(ModelPolicy):
    """The reference policy: chunks by flow matching, with one forward pass for all sessions of a batch."""

    Config: ClassVar[type] = ReferenceConfig
    trainable = network = "model.network"
    adaptable = True
    config: ReferenceConfig
    model: LoadedReference | None

    @property
    def contract(self) -> Contract:
        if self.model is None:
            return Contract(instruction=True, history=1)
        robot = self.model.robot
        return Contract(
            cameras=camera_specs(self.cameras),
            state=state_specs(self.state, len(robot.state_mean)),
            gripper=needs_gripper(self.state),
            instruction=True,
            action=ActionSpec(**robot.action),
            chunk=self.chunk(self.model.checkpoint.sizes.horizon),
            history=1,
            behaviour=self.offered(OFFERED if self.config.noise_level else ()),
        )

    @property
    def state_dim(self) -> int | None:
        return None if self.model is None else len(self.model.robot.state_mean)

    @property
    def cameras(self) -> dict[str, str]:
        """The model's name of each camera -> the robot's, in the order of the network."""
        chosen = choose_cameras(self.config.cameras, self.loaded().robot.cameras, CAMERAS)
        return {name: chosen[name] for name in CAMERAS}

    @property
    def state(self) -> list[str]:
        """The parts of the robot's proprioception, in the order of its state vector."""
        return self.config.state or self.loaded().robot.state

    @property
    def continues_plans(self) -> bool:
        return self.config.actions == "chunk"

    def load(self) -> LoadedReference:
        folder = find_checkpoint(self.config.checkpoint, self.config.checkpoint_step, needs=[CONFIG, WEIGHTS])
        checkpoint = read_checkpoint(folder)
        robot = _embodiment(checkpoint, self.config.embodiment, folder)
        device = torch_device(self.config.device)
        dtype = torch_dtype(self.config.dtype, device, preferred="float32")
        network = ReferenceNetwork(checkpoint.sizes)
        read_weights(network, folder)
        network = network.eval().requires_grad_(False).to(device, dtype)
        passes = ReferencePasses(network, self.compilation)
        passes.adapters = self.adapters
        if self.config.execute is None and robot.execute is not None:
            self.config = self.config.model_copy(update={"execute": robot.execute})
        return LoadedReference(network, checkpoint, robot, dtype, passes, Staging(device))

    def _begin(self, instruction: str, seed: int, adapter: str = "") -> None:
        super()._begin(instruction, seed, adapter)
        if self.model is not None:
            self._begun().prompt = self.model.checkpoint.tokens(instruction)

    def _example(self, seed: int, instruction: str = "") -> Row:
        return super()._example(seed, instruction or self.loaded().checkpoint.words[0])

    def perceive(self, obs: Obs) -> StagedRow:
        """Return the network's inputs for one row."""
        model = self.loaded()
        sizes, found = model.checkpoint.sizes, camera_images(obs, self.cameras)
        images = np.stack([resize_with_pad(found[name], sizes.side, sizes.side) for name in CAMERAS])
        state = normalised(model.robot, state_vector(obs, self.state, self.state_dim), sizes.state)
        staged: StagedRow = model.staging.stage({"tokens": self._begun().prompt, "images": images, "state": state})
        return staged

    def predict(self, rows: Sequence[Row]) -> list[Prediction]:
        model, config = self.loaded(), self.config
        shape, convert = (model.checkpoint.sizes.horizon, model.checkpoint.sizes.action), model.staging.upload
        noise = convert(np.stack([row.noise(*shape) for row in rows]))
        guide = Guide.of(rows, *shape)
        random = RandomSteps.of(rows, (config.steps, *shape), config.noise_level, convert)
        changes: list[Change] = []
        if guide is not None:
            changes.append(guide.to(convert).change(noise, steps=config.steps, limit=config.guidance))
        if random is not None:
            changes.append(random.change)
        firsts, owners = shared_frames(rows)
        with torch.inference_mode():
            inputs = self._inputs([rows[i] for i in firsts])
            tokens = inputs["tokens"]
            flow = model.passes.sample(
                inputs["images"].unbind(1),
                [torch.ones(len(tokens), dtype=torch.bool, device=tokens.device)] * len(CAMERAS),
                tokens,
                tokens != 0,
                inputs["state"],
                noise=noise,
                owners=owners,
                steps=config.steps,
                changes=changes,
                fingerprints=[row.adapter for row in rows],
            )
            stated = {} if random is None else random.stated(config.execute, shape[1])
        return [Prediction(one, behaviour=stated.get(i, {})) for i, one in enumerate(flow.cpu().numpy())]

    def _inputs(self, rows: Sequence[Row]) -> dict[str, Tensor]:
        """Stack the last frames of rows, in the type of the network."""
        model = self.loaded()
        inputs = model.staging.stack([row.frames[-1] for row in rows])
        images, state = pixels(inputs["images"]).to(model.dtype), inputs["state"].to(model.dtype)
        return {"tokens": inputs["tokens"], "images": images, "state": state}


def flow_velocity(network: ReferenceNetwork, inputs: Mapping[str, Tensor]) -> Callable[[Tensor, float], Tensor]:
    """Return the velocity for a learner, as a function of noisy actions (B, H, D) and time; inputs are encoded once.

    Args:
        network: The network.
        inputs: "tokens" (B, L), "images" (B, cameras, 3, S, S) as `pixels` returns them, and "state" (B, S).
    """
    context = network.encode(inputs["tokens"], inputs["state"], *inputs["images"].unbind(1))
    return lambda actions, time: network.velocity(context, actions, actions.new_full((len(actions),), time))


def pixels(images: Tensor) -> Tensor:
    """Return images (P, cameras, S, S, 3) uint8 as the network sees them, (P, cameras, 3, S, S) float32 in [-1, 1]."""
    return images.movedim(-1, 2).float().div_(127.5).sub_(1.0)


def normalised(robot: Embodiment, state: np.ndarray, length: int) -> np.ndarray:
    """Return the states (…, D) of a robot in the units of the network, (…, length) float32."""
    units = (state - np.array(robot.state_mean)) / np.maximum(robot.state_std, _LEAST_STD)
    filled = np.zeros((*units.shape[:-1], length), np.float32)
    filled[..., : units.shape[-1]] = units
    return filled


def read_checkpoint(folder: Path) -> Checkpoint:
    """Return what a checkpoint's `config.json` states; raises `ConfigError`."""
    try:
        return Checkpoint.model_validate_json((folder / CONFIG).read_text(encoding="utf-8"))
    except ValidationError as error:
        raise ConfigError(f"{folder / CONFIG}: is no checkpoint of the reference policy: {error}") from error


def read_weights(network: ReferenceNetwork, folder: Path) -> None:
    """Fill a network with a checkpoint's weights.

    Raises:
        ConfigError: They are damaged, or those of another network.
    """
    try:
        with (folder / WEIGHTS).open("rb") as file:
            values: Mapping[str, np.ndarray] = read_values(file)
        network.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in values.items()})
    except (VLAgentsError, RuntimeError) as error:
        said = " ".join(str(error).split())[:300]
        raise ConfigError(f"{folder / WEIGHTS}: cannot be read: {said}; copy the checkpoint again") from error


def _embodiment(checkpoint: Checkpoint, name: str | None, folder: Path) -> Embodiment:
    known = checkpoint.embodiments
    if name is None and len(known) == 1:
        return next(iter(known.values()))
    if name not in known:
        raise ConfigError(f"embodiment: got {name!r}, want one of {sorted(known)}, those of {folder}")
    return known[name]
