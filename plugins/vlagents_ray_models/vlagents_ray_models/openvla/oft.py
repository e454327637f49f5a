"""OpenVLA-OFT: computes a chunk of actions from images, proprioception and an instruction in one
forward pass.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, model_validator
from typing_extensions import Self

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import Prediction, Row
from vlagents_ray.policies.base.accelerator import fetch
from vlagents_ray.policies.base.model_inputs import (
    camera_images,
    choose_cameras,
    needs_gripper,
    state_vector,
)
from vlagents_ray.policies.base.staging import StagedRow
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.registry import require
from vlagents_ray_models.openvla import prismatic

_PRIMARY = "full_image"
# In the order of training.
_CAMERAS = (_PRIMARY, "wrist_image", "left_wrist_image", "right_wrist_image")
_USUAL = {_PRIMARY: "front", "wrist_image": "wrist"}  # of LIBERO
_STATE = ("xyz_axis_angle", "gripper_qpos")  # of LIBERO, 6 and 2 numbers


class OpenVLAOFTConfig(prismatic.PrismaticConfig):
    """Settings of OpenVLA-OFT; they must state how a checkpoint was trained, since its files do
    not.
    """

    attention: Literal["sdpa", "eager"] = Field(
        default="sdpa", description="of the language model; has no causal mask"
    )
    center_crop: bool = Field(
        default=True, description="trained with random crops (upstream's `image_aug`)"
    )
    head: Literal["l1", "diffusion", "tokens"] = Field(
        default="l1",
        description="how actions come out: by regression, by diffusion, or as tokens of bins",
    )
    film: bool = Field(default=False, description="trained with FiLM (OFT+)")
    horizon: int = Field(
        default=8, ge=1, description="rows of a chunk, as in training: LIBERO 8, ALOHA 25, Bridge 5"
    )
    bounds: prismatic.Bounds = Field(
        default="q99",
        description="of actions and states in training: 'q99', or 'min_max' for ALOHA's absolute "
        "joints",
    )
    diffusion_steps: int = Field(default=50, ge=1, description="of training")
    inference_steps: int = Field(
        default=50, ge=1, description="of diffusion, at most as many as in training"
    )

    @model_validator(mode="after")
    def _steps_fit(self) -> Self:
        if self.inference_steps > self.diffusion_steps:
            raise ValueError(
                f"inference_steps: got {self.inference_steps}, want at most {self.diffusion_steps}"
            )
        return self


class OpenVLAOFT(prismatic.PrismaticPolicy):
    """The policy OpenVLA-OFT, which returns a chunk for each `act`."""

    Config = OpenVLAOFTConfig
    config: OpenVLAOFTConfig
    model: Parallel
    trainable = "model.trained"

    def __init__(self, config: OpenVLAOFTConfig) -> None:
        super().__init__(config)
        chosen = config.cameras or _USUAL
        known = [name for name in _CAMERAS if name in chosen or name == _PRIMARY]
        self._cameras = choose_cameras(config.cameras, _USUAL, known)
        self._state = list(_STATE if config.state is None else config.state)

    @property
    def contract(self) -> Contract:
        gripper = needs_gripper(self._state) or None
        behaviour = self.offered(prismatic.OFFERED if self.config.head == "tokens" else ())
        facts = {"action": self._action(), "gripper": gripper, "behaviour": behaviour}
        return self.stated(self._cameras, self._state, self.config.horizon, **facts)

    @property
    def state_dim(self) -> int | None:
        return None if self.model is None or self.model.proprio is None else self.model.proprio.dim

    def load(self) -> Parallel:
        """Read the checkpoint and its components; raises `ConfigError` if one is missing or
        unused.
        """
        config = self.config
        base = prismatic.load_prismatic(config, config.bounds)
        place = {"device": base.device, "dtype": base.dtype}
        parts = {
            "action_head": config.head != "tokens",
            "proprio_projector": bool(self._state),
            "noisy_action_projector": config.head == "diffusion",
            "vision_backbone": config.film,
        }
        require_unused(base.path, [name for name, used in parts.items() if not used])
        saved = {name: read_component(base.path, name) for name, used in parts.items() if used}
        prefix = "noise_predictor.mlp_resnet" if config.head == "diffusion" else "model"
        head = Mlp(saved["action_head"], prefix).to(**place) if "action_head" in saved else None
        projectors = {
            name: Projector(saved[name], name).to(**place) if name in saved else None
            for name in ("proprio_projector", "noisy_action_projector")
        }
        parallel = Parallel(
            base,
            horizon=config.horizon,
            dim=_action_dim(base.statistics, config.unnorm_key, head),
            head=head,
            proprio=projectors["proprio_projector"],
            noisy=projectors["noisy_action_projector"],
            film=Film(saved["vision_backbone"], base.network.vision_backbone).to(**place)
            if config.film
            else None,
            steps=(config.diffusion_steps, config.inference_steps),
        )
        parallel.compile_with(self.compilation)
        return parallel

    def perceive(self, obs: Obs) -> tuple[StagedRow, np.ndarray | None]:
        """Return the images, in the order of training, as inputs of the backbones, and the state
        vector (P,).
        """
        seen = [prismatic.resized(image) for image in camera_images(obs, self._cameras).values()]
        if self.config.center_crop:
            seen = [prismatic.middle(image) for image in seen]
        projector = self.model.proprio
        state = None if projector is None else state_vector(obs, self._state, projector.dim)
        return self.model.base.stage(seen), state

    def _model_input(self, row: Row, key: str) -> ModelInput:
        seen, state = row.frames[-1]
        base = self.model.base
        if (dim := base.statistics.scale(key).dim) != self.model.dim:
            raise InvalidObservation(
                f"unnorm_key: got {key!r} of {dim} numbers, want one of {self.model.dim}, the "
                "head's"
            )
        proprio = None if state is None else base.statistics.scale(key, "proprio").normalise(state)
        return ModelInput(seen, base.tokens(row.instruction), proprio)

    def _compute(self, prepared: Sequence[prismatic.PreparedRow]) -> list[Prediction]:
        """Run one forward pass, or one per diffusion step. Regression gives a session's samples
        the same answer.
        """
        firsts, owners = self.observations_of([entry.row for entry in prepared])
        inputs = [prepared[i].model_input for i in firsts]
        shape = (self.model.horizon, self.model.dim)
        if self.config.head == "tokens":
            draws = np.stack(
                [
                    entry.row.rng.random(shape) if entry.row.sample else np.full(shape, np.nan)
                    for entry in prepared
                ]
            )
            return self._decoded(
                self.model.base.bins, prepared, *self.model.choose(inputs, owners, draws)
            )
        if self.config.head == "l1":
            chunks = self.model.regress(inputs)[owners]
        else:
            chunks = self.model.denoise(
                inputs, owners, np.stack([entry.row.noise(*shape) for entry in prepared])
            )
        return [
            Prediction(entry.scale.restore(chunk))
            for entry, chunk in zip(prepared, chunks, strict=True)
        ]


def _action_dim(statistics: prismatic.Statistics, unnorm_key: str | None, head: Mlp | None) -> int:
    """Return the length of an action, which must be the same for the head and all datasets that
    episodes may select.
    """
    dims = statistics.action_dims(unnorm_key)
    if head is not None:
        dims.add(head.dim)
    if len(dims) != 1:
        raise ConfigError(
            f"actions: the checkpoint's head and statistics have {sorted(dims)} numbers a row, "
            "want one length; set unnorm_key to the dataset that the head was trained on"
        )
    return dims.pop()


_STOP = 2  # Llama's end of text, which follows the actions in training


@dataclass(frozen=True)
class ModelInput:
    """The inputs for one chunk."""

    seen: StagedRow
    tokens: list[int]
    proprio: np.ndarray | None  # (P,) in [-1, 1]


class Sequences(NamedTuple):
    """The parts of sequences of embeddings that are known before the actions, and how they make
    up a sequence.
    """

    seen: Any  # (B, P, D), of images and state
    words: Any  # (B, L, D)
    places: Any  # (B, T), as for `Prismatic.assembled`; the actions are the last part
    lengths: Any  # (B,), without padding


@dataclass
class Parallel:
    """A checkpoint of OFT: OpenVLA's, and its components; a component is None if training did not
    use it.

    `encode_images` and `hidden_states` are functions of tensors, which `compile_with` replaces by
    their compiled forms.
    """

    base: prismatic.Prismatic
    horizon: int  # H, the number of rows of a chunk
    dim: int  # D, the length of a row
    head: Mlp | None  # None: action tokens
    proprio: Projector | None
    noisy: Projector | None  # embeds noisy actions: the head is a diffusion head
    film: Film | None
    steps: tuple[int, int]  # diffusion steps: in training, at inference

    @property
    def trained(self) -> dict[str, Any]:
        """The parts that upstream's training saves: modules, and tensors by their names in its
        files.
        """
        added = {
            "action_head": self.head,
            "proprio_projector": self.proprio,
            "noisy_action_projector": self.noisy,
            "film": self.film,
        }
        return {
            "vla": self.base.network,
            **{name: part.weights for name, part in added.items() if part is not None},
        }

    def compile_with(self, compilation: Compilation) -> None:
        self.encode_images = compilation.core("vision encoder", self.encode_images)  # type: ignore[method-assign]
        self.hidden_states = compilation.core("language model", self.hidden_states)  # type: ignore[method-assign]

    def regress(self, inputs: Sequence[ModelInput]) -> np.ndarray:
        with require("torch").inference_mode():
            return fetch(self._heads(self._hidden(self._sequences(inputs))).float())

    def denoise(
        self, inputs: Sequence[ModelInput], owners: Sequence[int], noise: np.ndarray
    ) -> np.ndarray:
        """Denoise chunks (B, H, D) in [-1, 1] from standard normal noise, for the inputs
        `owners` (B,).
        """
        with require("torch").inference_mode():
            sequences = self._sequences(inputs)
            index = self.base.moved(owners)
            sequences = Sequences(*(part[index] for part in sequences))
            start = self.base.moved(noise).to(self.base.dtype)
            return fetch(
                denoise(
                    start, lambda time, noisy: self._noise(sequences, time, noisy), *self.steps
                ).float()
            )

    def choose(
        self, inputs: Sequence[ModelInput], owners: Sequence[int], draws: np.ndarray
    ) -> tuple[Any, Any]:
        """Choose tokens (B, H, D) for the inputs `owners` (B,), by draws (B, H, D) as in
        `ActionBins.choose`.

        Returns the tokens, and the logits of the bins (B, H, D, bins) there.
        """
        with require("torch").inference_mode():
            hidden = self._hidden(self._sequences(inputs)).unflatten(1, (self.horizon, self.dim))
            index, bins = self.base.moved(owners), self.base.bins
            likeliest, over = (
                one[index] for one in bins.read(self.base.network.language_model.lm_head(hidden))
            )
            return bins.choose(likeliest, over, self.base.moved(draws)), over

    def _heads(self, hidden: Any) -> Any:
        return self.head(hidden.reshape(len(hidden), self.horizon, -1))  # type: ignore[misc]

    def _noise(self, sequences: Sequences, time: int, actions: Any) -> Any:
        seen = sequences.seen
        now = (
            time_embedding(time, seen.shape[-1], actions.device)
            .to(actions.dtype)
            .expand(len(seen), 1, -1)
        )
        noisy = self.noisy(actions.flatten(1)[..., None])  # type: ignore[misc]
        return self._heads(
            self._hidden(sequences._replace(seen=require("torch").cat([seen, now], 1)), noisy)
        )

    def _sequences(self, inputs: Sequence[ModelInput]) -> Sequences:
        """Return the sequences of inputs; for a diffusion head, with a place for the time after
        images and state.
        """
        torch, base = require("torch"), self.base
        prompts, timed = (
            [[*model_input.tokens, _STOP] for model_input in inputs],
            self.noisy is not None,
        )
        words, counts = (
            base.embed(base.padded(prompts)),
            base.moved([len(tokens) for tokens in prompts]),
        )
        padding = torch.arange(words.shape[1], device=base.device) >= counts[:, None]
        language = words.float().masked_fill(padding[..., None], 0).sum(1) / counts[:, None]
        pixels = base.pixels([model_input.seen for model_input in inputs])
        seen = self.encode_images(pixels, language.to(words.dtype))
        if self.proprio is not None:
            states = base.moved([model_input.proprio for model_input in inputs]).to(base.dtype)
            seen = torch.cat([seen, self.proprio(states)[:, None]], 1)
        # `first`: place of a row's first token.
        first, count = 1 + seen.shape[1] + timed, self.horizon * self.dim
        # Zeros without a diffusion head.
        actions = [(first + words.shape[1] + i) * timed for i in range(count)]
        lasts = [first + len(tokens) - 1 for tokens in prompts]
        places = [
            [first, *range(1, first), *range(first + 1, last), *actions, last] for last in lasts
        ]
        length = first - 1 + count + max(words.shape[1], base.padded_tokens)
        return Sequences(seen, words, base.padded(places, length), counts + (first - 1 + count))

    def encode_images(self, pixels: Any, language: Any) -> Any:
        """Return the embeddings (P, N, D) of images (P, views, C, S, S); `language` (P, D) is
        the mean of the words.
        """
        views = pixels.shape[1]
        images = pixels.flatten(0, 1)
        if self.film is None:
            patches = self.base.network.vision_backbone(images)
        else:
            patches = self.film(images, language.repeat_interleave(views, 0))
        return self.base.network.projector(patches).unflatten(0, (len(pixels), views)).flatten(1, 2)

    def hidden_states(self, embeddings: Any, lengths: Any) -> Any:
        """Return hidden states (B, L, D) of sequences (B, L, D); each token attends to the whole
        length of its row.
        """
        import torch  # the compiler follows an import statement, but not `require`

        model, length = self.base.network.language_model.model, embeddings.shape[1]
        places = lengths.new_ones(1, length).cumsum(1) - 1
        hidden = (places >= lengths[:, None])[:, None, None].expand(-1, 1, length, -1)
        mask = (
            embeddings.new_zeros(1)
            .expand(hidden.shape)
            .masked_fill(hidden, torch.finfo(embeddings.dtype).min)
        )
        for layer in model.layers:
            [embeddings] = layer(embeddings, attention_mask=mask, position_ids=places)
        return model.norm(embeddings)

    def _hidden(self, sequences: Sequences, *actions: Any) -> Any:
        """Return hidden states (B, H * D, …) of the action tokens: `actions` for a diffusion
        head, else zeros.
        """
        lengths, count = sequences.lengths, self.horizon * self.dim
        embeddings = self.base.assembled(
            [sequences.seen, sequences.words, *actions], sequences.places
        )
        hidden = self.hidden_states(embeddings, lengths)
        # the preceding token predicts an action, as in training
        places = (
            lengths[:, None] - count - 2 + require("torch").arange(count, device=self.base.device)
        )
        return hidden.take_along_dim(places[..., None], 1)


def denoise(noise: Any, predict: Callable[[int, Any], Any], trained: int, steps: int) -> Any:
    """Denoise actions by DDIM, without noise between steps.

    Args:
        noise: (B, H, D), standard normal.
        predict: Returns the noise in actions (B, H, D) at a time of training.
        trained: The number of diffusion steps in training.
        steps: The number of diffusion steps at inference.

    Returns:
        (B, H, D) in [-1, 1].
    """
    kept, stride = _kept(trained), trained // steps
    for time in reversed(range(0, steps * stride, stride)):
        guessed, before = predict(time, noise), time - stride
        clean = (noise - (1 - kept[time]) ** 0.5 * guessed) / kept[time] ** 0.5
        left = kept[before] if before >= 0 else 1.0
        noise = left**0.5 * clean.clamp(-1, 1) + (1 - left) ** 0.5 * guessed
    return noise


def time_embedding(time: int, dim: int, device: Any) -> Any:
    """Return the embedding of a time, (dim,) float32: sines, then cosines."""
    torch = require("torch")
    half = dim // 2
    rates = torch.exp(torch.arange(half, device=device) * -math.log(10000) / (half - 1))
    return torch.cat([(time * rates).sin(), (time * rates).cos()])


def _kept(trained: int) -> list[float]:
    """Return the share of the signal that remains at each time of training."""

    def alpha(x: float) -> float:
        return math.cos((x + 0.008) / 1.008 * math.pi / 2) ** 2

    betas = [min(1 - alpha((i + 1) / trained) / alpha(i / trained), 0.999) for i in range(trained)]
    kept: list[float] = np.cumprod(1 - np.array(betas, np.float32)).tolist()
    return kept


Weights = dict[str, Any]  # tensors by name

_MLP = (
    "layer_norm1",
    "fc1",
    *(f"mlp_resnet_blocks.{i}.ffn.{j}" for i in (0, 1) for j in (0, 1)),
    "layer_norm2",
    "fc2",
)
_WRAPPED = "module."  # prefix of all names after distributed training
_LORA_ALPHA = 16  # upstream's scale is min(rank, 16) / rank


def read_component(folder: Path, name: str) -> dict[str, Any]:
    """Return the tensors of the only file `name--*_checkpoint.pt`; raises `ConfigError` if there
    is none or several.
    """
    files = sorted(path.name for path in folder.glob(f"{name}--*checkpoint.pt"))
    if len(files) != 1:
        have = sorted(path.name for path in folder.glob("*.pt"))
        raise ConfigError(
            f"checkpoint {folder}: got {files or have} for {name!r}, want one file "
            f"{name}--STEP_checkpoint.pt; copy it there, or check `head`, `film` and `state` "
            "against how the checkpoint was trained"
        )
    saved = require("torch").load(folder / files[0], map_location="cpu", weights_only=True)
    return {key.removeprefix(_WRAPPED): tensor for key, tensor in saved.items()}


def require_unused(folder: Path, names: Iterable[str]) -> None:
    """Raise `ConfigError` if there is a component that the settings omit."""
    for name in names:
        if any(folder.glob(f"{name}--*")):
            raise ConfigError(
                f"checkpoint {folder}: has {name}--…, which these settings do not use; set `head`, "
                "`film` and `state` to how the checkpoint was trained, or move the file away"
            )


def _exactly(found: Weights, layers: Iterable[str], what: str) -> Weights:
    want = {f"{layer}.{part}" for layer in layers for part in ("weight", "bias")}
    if set(found) != want:
        raise ConfigError(
            f"{what}: misses {sorted(want - set(found))}, has {sorted(set(found) - want)} too; is "
            "it of another kind?"
        )
    return found


class Component:
    """A part that fine-tuning added to OpenVLA, by the names of its tensors."""

    weights: Weights  # by upstream's names, which a learner pushes
    _prefix = ""  # of all names

    def to(self, **place: Any) -> Self:
        self.weights = {key: tensor.to(**place) for key, tensor in self.weights.items()}
        return self

    def _linear(self, layer: str, x: Any) -> Any:
        import torch  # the compiler follows an import statement, but not `require`

        return torch.nn.functional.linear(x, *self._of(layer))

    def _of(self, layer: str) -> tuple[Any, Any]:
        return self.weights[f"{self._prefix}{layer}.weight"], self.weights[
            f"{self._prefix}{layer}.bias"
        ]


class Mlp(Component):
    """A head: an MLP with residual blocks over the hidden states of one row's action tokens."""

    def __init__(self, saved: Weights, prefix: str) -> None:
        self.weights = _exactly(saved, [f"{prefix}.{layer}" for layer in _MLP], "action_head")
        self._prefix = f"{prefix}."

    @property
    def dim(self) -> int:
        return len(self._of("fc2")[1])

    def __call__(self, x: Any) -> Any:
        relu = require("torch").relu
        x = relu(self._linear("fc1", self._norm("layer_norm1", x)))
        for i in (0, 1):
            block = f"mlp_resnet_blocks.{i}.ffn"
            x = x + relu(self._linear(f"{block}.1", self._norm(f"{block}.0", x)))
        return self._linear("fc2", self._norm("layer_norm2", x))

    def _norm(self, layer: str, x: Any) -> Any:
        weight, bias = self._of(layer)
        return require("torch").nn.functional.layer_norm(x, bias.shape, weight, bias)


class Projector(Component):
    """Maps numbers to embeddings of the language model, by two layers with GELU between them."""

    def __init__(self, saved: Weights, what: str) -> None:
        self.weights = _exactly(saved, ("fc1", "fc2"), what)

    @property
    def dim(self) -> int:
        return int(self.weights["fc1.weight"].shape[1])

    def __call__(self, x: Any) -> Any:
        return self._linear("fc2", require("torch").nn.functional.gelu(self._linear("fc1", x)))


class Film(Component):
    """Vision backbones whose blocks are scaled and shifted by the instruction (arXiv
    1709.07871).
    """

    def __init__(self, saved: Weights, backbone: Any) -> None:
        """Take FiLM's tensors from `saved`, and load the other tensors into the backbone."""
        plain, film = {}, {}
        for key, tensor in _merged(saved).items():
            name = key.removeprefix("vision_backbone.")
            if ".scale." in name or ".shift." in name:
                film[name] = tensor
            else:
                plain[name.replace(".block.", ".")] = tensor
        try:
            backbone.load_state_dict(plain)
        except RuntimeError as error:
            raise ConfigError(f"vision_backbone: not the checkpoint's ({error})") from error
        vits = {
            n: getattr(backbone, n)
            for n in ("featurizer", "fused_featurizer")
            if hasattr(backbone, n)
        }
        layers = [
            f"{n}.blocks.{i}.{way}"
            for n, v in vits.items()
            for i in range(len(v.blocks))
            for way in ("scale", "shift")
        ]
        self.weights, self._vits = _exactly(film, layers, "vision_backbone"), vits

    def __call__(self, pixels: Any, language: Any) -> Any:
        """Return patches (B, P, V) of pixels (B, C, S, S) for instructions (B, D), each the mean
        of its embeddings.
        """
        import torch  # the compiler follows an import statement, but not `require`

        parts = pixels.split(3, dim=1)
        return torch.cat(
            [self._see(name, part, language) for name, part in zip(self._vits, parts, strict=True)],
            dim=2,
        )

    def _see(self, name: str, pixels: Any, language: Any) -> Any:
        """Return the output of the second to last block, which OpenVLA uses."""
        vit = self._vits[name]
        x = vit.norm_pre(vit.patch_drop(vit._pos_embed(vit.patch_embed(pixels))))
        for i, block in enumerate(vit.blocks[:-1]):
            layer = f"{name}.blocks.{i}"
            scale, shift = (
                self._linear(f"{layer}.{way}", language)[:, None] for way in ("scale", "shift")
            )
            x = x + block.ls1(block.attn(block.norm1(x)))
            x = x * (1 + scale) + shift
            x = x + block.ls2(block.mlp(block.norm2(x)))
        return x[:, vit.num_prefix_tokens :]


def _merged(saved: Weights) -> dict[str, Any]:
    """Add the low-rank adapters to their layers, including convolutions; OFT+ saves adapters
    separately.
    """
    merged = {
        key.replace(".base_layer.", "."): tensor
        for key, tensor in saved.items()
        if ".lora_" not in key
    }
    for key, down in saved.items():
        if ".lora_A." in key:
            up = saved[key.replace(".lora_A.", ".lora_B.")]
            rank = len(down)
            name = key.partition(".lora_A.")[0] + ".weight"
            added = (
                up.flatten(1).float() @ down.flatten(1).float() * (min(rank, _LORA_ALPHA) / rank)
            )
            merged[name] = (merged[name].float() + added.view_as(merged[name])).to(
                merged[name].dtype
            )
    return merged
