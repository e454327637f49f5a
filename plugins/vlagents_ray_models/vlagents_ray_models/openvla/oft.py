"""OpenVLA-OFT, which computes a chunk of actions from images, proprioception and an instruction in
one forward pass.
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
# The cameras, in the order of training.
_CAMERAS = (_PRIMARY, "wrist_image", "left_wrist_image", "right_wrist_image")
# The defaults for LIBERO: the model's name of each camera -> our camera, and the parts of the
# state, which have 6 and 2 numbers.
_DEFAULT_CAMERAS = {_PRIMARY: "front", "wrist_image": "wrist"}
_DEFAULT_STATE = ("xyz_axis_angle", "gripper_qpos")


class OpenVLAOFTConfig(prismatic.PrismaticConfig):
    """Settings of OpenVLA-OFT.

    They must describe how a checkpoint was trained, since the checkpoint's files do not contain
    this.
    """

    attention: Literal["sdpa", "eager"] = Field(
        default="sdpa", description="attention of the language model, which has no causal mask"
    )
    center_crop: bool = Field(
        default=True,
        description="whether it was trained with random crops (upstream's `image_aug`)",
    )
    head: Literal["l1", "diffusion", "tokens"] = Field(
        default="l1",
        description="how actions are predicted: by regression, by diffusion, or as tokens of bins",
    )
    film: bool = Field(default=False, description="whether it was trained with FiLM (OFT+)")
    horizon: int = Field(
        default=8, ge=1, description="rows of a chunk, as in training: LIBERO 8, ALOHA 25, Bridge 5"
    )
    bounds: prismatic.Bounds = Field(
        default="q99",
        description="bounds of actions and states in training: 'q99', or 'min_max' for ALOHA's "
        "absolute joints",
    )
    diffusion_steps: int = Field(default=50, ge=1, description="diffusion steps of the training")
    inference_steps: int = Field(
        default=50, ge=1, description="diffusion steps of a call, at most as many as in training"
    )

    @model_validator(mode="after")
    def _steps_fit(self) -> Self:
        if self.inference_steps > self.diffusion_steps:
            raise ValueError(
                f"inference_steps: expected at most {self.diffusion_steps}, got "
                f"{self.inference_steps}"
            )
        return self


class OpenVLAOFT(prismatic.PrismaticPolicy):
    """The policy OpenVLA-OFT, which returns a chunk for each call."""

    Config = OpenVLAOFTConfig
    config: OpenVLAOFTConfig
    model: Parallel
    trainable = "model.trained"

    def __init__(self, config: OpenVLAOFTConfig) -> None:
        super().__init__(config)
        chosen = config.cameras or _DEFAULT_CAMERAS
        used = [name for name in _CAMERAS if name in chosen or name == _PRIMARY]
        self._cameras = choose_cameras(config.cameras, _DEFAULT_CAMERAS, used)
        self._state = list(_DEFAULT_STATE if config.state is None else config.state)

    @property
    def contract(self) -> Contract:
        gripper = needs_gripper(self._state) or None
        behaviour = self.offered(prismatic.OFFERED if self.config.head == "tokens" else ())
        facts = {"action": self._action(), "gripper": gripper, "behaviour": behaviour}
        return self.make_contract(self._cameras, self._state, self.config.horizon, **facts)

    @property
    def state_dim(self) -> int | None:
        return None if self.model is None or self.model.proprio is None else self.model.proprio.dim

    def load(self) -> Parallel:
        """Read the checkpoint and its components.

        Raises:
            ConfigError: A component is missing, unused, or has other tensors than expected.
        """
        config = self.config
        base = prismatic.load_prismatic(config, config.bounds)
        saved = self._read_components(base.path)

        target = {"device": base.device, "dtype": base.dtype}
        head = proprio = noisy = film = None
        if "action_head" in saved:
            prefix = "noise_predictor.mlp_resnet" if config.head == "diffusion" else "model"
            head = Mlp(saved["action_head"], prefix).to(**target)
        if "proprio_projector" in saved:
            proprio = Projector(saved["proprio_projector"], "proprio_projector").to(**target)
        if "noisy_action_projector" in saved:
            weights = saved["noisy_action_projector"]
            noisy = Projector(weights, "noisy_action_projector").to(**target)
        dim = _action_dim(base.statistics, config.unnorm_key, head)
        if "vision_backbone" in saved:
            film = Film(saved["vision_backbone"], base.network.vision_backbone).to(**target)

        parallel = Parallel(
            base,
            horizon=config.horizon,
            dim=dim,
            head=head,
            proprio=proprio,
            noisy=noisy,
            film=film,
            steps=(config.diffusion_steps, config.inference_steps),
        )
        parallel.compile_with(self.compilation)
        return parallel

    def _read_components(self, folder: Path) -> dict[str, Weights]:
        """Read the files of the components that the settings use.

        Raise `ConfigError` if a file is missing, or if there is a file of a component that the
        settings do not use.
        """
        uses = {
            "action_head": self.config.head != "tokens",
            "proprio_projector": bool(self._state),
            "noisy_action_projector": self.config.head == "diffusion",
            "vision_backbone": self.config.film,
        }
        require_unused(folder, [name for name, is_used in uses.items() if not is_used])
        return {name: read_component(folder, name) for name, is_used in uses.items() if is_used}

    def perceive(self, obs: Obs) -> tuple[StagedRow, np.ndarray | None]:
        """Return the images, in the order of training, as inputs of the backbones, and the state
        vector, (P,).
        """
        images = [prismatic.resize(image) for image in camera_images(obs, self._cameras).values()]
        if self.config.center_crop:
            images = [prismatic.crop_center(image) for image in images]

        projector = self.model.proprio
        state = None if projector is None else state_vector(obs, self._state, projector.dim)
        return self.model.base.stage(images), state

    def _model_input(self, row: Row, key: str) -> ModelInput:
        images, state = row.frames[-1]
        base = self.model.base
        dim = base.statistics.scale(key).dim
        if dim != self.model.dim:
            raise InvalidObservation(
                f"unnorm_key: expected a dataset of {self.model.dim} numbers, as the head's, got "
                f"{key!r} of {dim}"
            )

        proprio = None
        if state is not None:
            proprio = base.statistics.scale(key, "proprio").normalise(state)
        return ModelInput(images, base.tokens(row.instruction), proprio)

    def _compute(self, prepared: Sequence[prismatic.PreparedRow]) -> list[Prediction]:
        """Run one forward pass, or one pass per diffusion step.

        With regression, all samples of a session are equal.
        """
        firsts, owners = self.observations_of([entry.row for entry in prepared])
        inputs = [prepared[i].model_input for i in firsts]
        shape = (self.model.horizon, self.model.dim)

        if self.config.head == "tokens":
            draws = np.full((len(prepared), *shape), np.nan)
            for row_draws, entry in zip(draws, prepared, strict=True):
                if entry.row.sample:
                    row_draws[:] = entry.row.rng.random(shape)
            tokens, bin_logits = self.model.choose(inputs, owners, draws)
            return self._decoded(self.model.base.bins, prepared, tokens, bin_logits)

        if self.config.head == "l1":
            chunks = self.model.regress(inputs)[owners]
        else:
            noise = np.stack([entry.row.noise(*shape) for entry in prepared])
            chunks = self.model.denoise(inputs, owners, noise)
        restored = [
            entry.scale.restore(chunk) for entry, chunk in zip(prepared, chunks, strict=True)
        ]
        return [Prediction(chunk) for chunk in restored]


def _action_dim(statistics: prismatic.Statistics, unnorm_key: str | None, head: Mlp | None) -> int:
    """Return the length of an action.

    It must be the same for the head and for all datasets that episodes may select.
    """
    dims = statistics.action_dims(unnorm_key)
    if head is not None:
        dims.add(head.dim)
    if len(dims) != 1:
        raise ConfigError(
            "actions: expected one length of rows in the checkpoint's head and statistics, got "
            f"{sorted(dims)}; set unnorm_key to the dataset that the head was trained on"
        )
    return dims.pop()


_STOP = 2  # Llama's end-of-text token, which follows the actions in training


@dataclass(frozen=True)
class ModelInput:
    """The inputs for one chunk."""

    images: StagedRow
    tokens: list[int]
    proprio: np.ndarray | None  # state vector, (P,) in [-1, 1]


class Sequences(NamedTuple):
    """The embeddings from which sequences are assembled, without the embeddings of the actions, and
    the order of the tokens.
    """

    perceived: Any  # embeddings of images and state, (B, P, D)
    words: Any  # embeddings of the words, (B, L, D)
    indices: Any  # indices for `Prismatic.assemble`, (B, T); the actions are the last segment
    lengths: Any  # lengths without padding, (B,)


@dataclass
class Parallel:
    """A checkpoint of OpenVLA-OFT: the checkpoint of OpenVLA, and the added components.

    A component is None if training did not use it. `encode_images` and `hidden_states` are
    functions of tensors, which `compile_with` replaces with their compiled forms.
    """

    base: prismatic.Prismatic
    horizon: int  # H, the number of rows of a chunk
    dim: int  # D, the length of a row
    head: Mlp | None  # None with action tokens
    proprio: Projector | None
    noisy: Projector | None  # embeds noisy actions; only for a diffusion head
    film: Film | None
    steps: tuple[int, int]  # number of diffusion steps in training, and at inference

    @property
    def trained(self) -> dict[str, Any]:
        """The components that upstream's training saves: modules, or tensors by their names in
        upstream's files.
        """
        components = {
            "action_head": self.head,
            "proprio_projector": self.proprio,
            "noisy_action_projector": self.noisy,
            "film": self.film,
        }
        trained: dict[str, Any] = {"vla": self.base.network}
        for name, component in components.items():
            if component is not None:
                trained[name] = component.weights
        return trained

    def compile_with(self, compilation: Compilation) -> None:
        """Replace the forward passes with their compiled forms, if compilation is enabled."""
        self.encode_images = compilation.core("vision encoder", self.encode_images)  # type: ignore[method-assign]
        self.hidden_states = compilation.core("language model", self.hidden_states)  # type: ignore[method-assign]

    def regress(self, inputs: Sequence[ModelInput]) -> np.ndarray:
        """Compute chunks, (B, H, D) in [-1, 1], in one pass, with the regression head."""
        with require("torch").inference_mode():
            hidden = self._hidden(self._sequences(inputs))
            return fetch(self._apply_head(hidden).float())

    def denoise(
        self, inputs: Sequence[ModelInput], owners: Sequence[int], noise: np.ndarray
    ) -> np.ndarray:
        """Denoise chunks.

        Args:
            inputs: The inputs, which several chunks may share.
            owners: (B,), the input of each chunk.
            noise: (B, H, D), standard normal.

        Returns:
            The chunks, (B, H, D) in [-1, 1].
        """
        with require("torch").inference_mode():
            index = self.base.upload(owners)
            sequences = Sequences(*(values[index] for values in self._sequences(inputs)))

            def predict(time: int, actions: Any) -> Any:
                return self._predict_noise(sequences, time, actions)

            start = self.base.upload(noise).to(self.base.dtype)
            return fetch(denoise(start, predict, *self.steps).float())

    def choose(
        self, inputs: Sequence[ModelInput], owners: Sequence[int], draws: np.ndarray
    ) -> tuple[Any, Any]:
        """Choose the tokens of chunks.

        Args:
            inputs: The inputs, which several chunks may share.
            owners: (B,), the input of each chunk.
            draws: (B, H, D), as in `ActionBins.choose`.

        Returns:
            The tokens (B, H, D), and the logits of the bins (B, H, D, bins) from which they were
            chosen.
        """
        with require("torch").inference_mode():
            hidden = self._hidden(self._sequences(inputs)).unflatten(1, (self.horizon, self.dim))
            index, bins = self.base.upload(owners), self.base.bins
            likeliest, bin_logits = bins.read(self.base.network.language_model.lm_head(hidden))
            likeliest, bin_logits = likeliest[index], bin_logits[index]
            return bins.choose(likeliest, bin_logits, self.base.upload(draws)), bin_logits

    def _apply_head(self, hidden: Any) -> Any:
        """Return the head's output, (B, H, D), for hidden states, (B, H * D, …)."""
        return self.head(hidden.reshape(len(hidden), self.horizon, -1))  # type: ignore[misc]

    def _predict_noise(self, sequences: Sequences, time: int, actions: Any) -> Any:
        """Return the predicted noise in actions, (B, H, D), at a diffusion time of training."""
        perceived = sequences.perceived
        embedding = time_embedding(time, perceived.shape[-1], actions.device).to(actions.dtype)
        embedding = embedding.expand(len(perceived), 1, -1)
        timed = sequences._replace(perceived=require("torch").cat([perceived, embedding], 1))
        noisy = self.noisy(actions.flatten(1)[..., None])  # type: ignore[misc]
        return self._apply_head(self._hidden(timed, noisy))

    def _sequences(self, inputs: Sequence[ModelInput]) -> Sequences:
        """Return the sequences of inputs.

        For a diffusion head, they have a position for the time after images and state.
        """
        torch, base = require("torch"), self.base
        prompts = [[*model_input.tokens, _STOP] for model_input in inputs]
        words = base.embed(base.pad(prompts))
        counts = base.upload([len(tokens) for tokens in prompts])

        # FiLM reads the mean embedding of a prompt's words.
        padding = torch.arange(words.shape[1], device=base.device) >= counts[:, None]
        language = words.float().masked_fill(padding[..., None], 0).sum(1) / counts[:, None]
        pixels = base.pixels([model_input.images for model_input in inputs])
        perceived = self.encode_images(pixels, language.to(words.dtype))
        if self.proprio is not None:
            states = base.upload([model_input.proprio for model_input in inputs]).to(base.dtype)
            perceived = torch.cat([perceived, self.proprio(states)[:, None]], 1)

        # Indices into the concatenation of images and state, the time, the words and the actions,
        # counted from 1.
        has_time = self.noisy is not None
        first = 1 + perceived.shape[1] + has_time  # index of the row's first token
        action_count = self.horizon * self.dim
        if has_time:
            first_action = first + words.shape[1]
            actions = list(range(first_action, first_action + action_count))
        else:
            actions = [0] * action_count  # index 0 selects a vector of zeros
        order = []
        for tokens in prompts:
            last = first + len(tokens) - 1
            order.append([first, *range(1, first), *range(first + 1, last), *actions, last])

        longest = max(words.shape[1], base.padded_tokens)
        indices = base.pad(order, first - 1 + action_count + longest)
        return Sequences(perceived, words, indices, counts + (first - 1 + action_count))

    def encode_images(self, pixels: Any, language: Any) -> Any:
        """Return the embeddings, (P, N, D), of images, (P, views, C, S, S).

        `language`, (P, D), is the mean embedding of the words.
        """
        views = pixels.shape[1]
        images = pixels.flatten(0, 1)
        if self.film is None:
            patches = self.base.network.vision_backbone(images)
        else:
            patches = self.film(images, language.repeat_interleave(views, 0))
        return self.base.network.projector(patches).unflatten(0, (len(pixels), views)).flatten(1, 2)

    def hidden_states(self, embeddings: Any, lengths: Any) -> Any:
        """Run the language model on sequences, without a causal mask: each token attends to all
        tokens of its row.

        Args:
            embeddings: The sequences, (B, L, D).
            lengths: Their lengths without padding, (B,).

        Returns:
            The hidden states, (B, L, D).
        """
        import torch  # torch's compiler follows an import statement, but not `require`

        model, length = self.base.network.language_model.model, embeddings.shape[1]
        positions = lengths.new_ones(1, length).cumsum(1) - 1
        hidden = (positions >= lengths[:, None])[:, None, None].expand(-1, 1, length, -1)
        shown = embeddings.new_zeros(1).expand(hidden.shape)
        mask = shown.masked_fill(hidden, torch.finfo(embeddings.dtype).min)
        for layer in model.layers:
            [embeddings] = layer(embeddings, attention_mask=mask, position_ids=positions)
        return model.norm(embeddings)

    def _hidden(self, sequences: Sequences, *actions: Any) -> Any:
        """Return the hidden states, (B, H * D, …), from which the numbers of the actions are
        predicted.

        Args:
            sequences: The sequences.
            actions: The embeddings of noisy actions, (B, H * D, …), for a diffusion head; other
                heads use zeros instead.
        """
        segments = [sequences.perceived, sequences.words, *actions]
        embeddings = self.base.assemble(segments, sequences.indices)
        hidden = self.hidden_states(embeddings, sequences.lengths)

        # As in training, the token before an action predicts the action.
        count = self.horizon * self.dim
        offsets = require("torch").arange(count, device=self.base.device)
        positions = sequences.lengths[:, None] - count - 2 + offsets
        return hidden.take_along_dim(positions[..., None], 1)


def denoise(noise: Any, predict: Callable[[int, Any], Any], trained: int, steps: int) -> Any:
    """Denoise actions with DDIM, without noise between steps.

    Args:
        noise: (B, H, D), standard normal.
        predict: A function that returns the predicted noise in actions, (B, H, D), at a diffusion
            time of training.
        trained: The number of diffusion steps in training.
        steps: The number of diffusion steps at inference.

    Returns:
        (B, H, D) in [-1, 1].
    """
    signal_shares = _signal_shares(trained)
    stride = trained // steps
    actions = noise
    for time in reversed(range(0, steps * stride, stride)):
        predicted = predict(time, actions)
        share = signal_shares[time]
        clean = (actions - (1 - share) ** 0.5 * predicted) / share**0.5
        next_share = signal_shares[time - stride] if time >= stride else 1.0
        actions = next_share**0.5 * clean.clamp(-1, 1) + (1 - next_share) ** 0.5 * predicted
    return actions


def time_embedding(time: int, dim: int, device: Any) -> Any:
    """Return the embedding of a diffusion time, (dim,) float32: sines, then cosines."""
    torch = require("torch")
    half = dim // 2
    rates = torch.exp(torch.arange(half, device=device) * -math.log(10000) / (half - 1))
    return torch.cat([(time * rates).sin(), (time * rates).cos()])


def _signal_shares(trained: int) -> list[float]:
    """Return the share of the signal in noisy actions at each diffusion time of training."""

    def alpha(x: float) -> float:
        return math.cos((x + 0.008) / 1.008 * math.pi / 2) ** 2

    betas = [min(1 - alpha((i + 1) / trained) / alpha(i / trained), 0.999) for i in range(trained)]
    shares: list[float] = np.cumprod(1 - np.array(betas, np.float32)).tolist()
    return shares


Weights = dict[str, Any]  # name -> tensor

# The names of the layers of a head.
_MLP = (
    "layer_norm1",
    "fc1",
    "mlp_resnet_blocks.0.ffn.0",
    "mlp_resnet_blocks.0.ffn.1",
    "mlp_resnet_blocks.1.ffn.0",
    "mlp_resnet_blocks.1.ffn.1",
    "layer_norm2",
    "fc2",
)
_WRAPPED = "module."  # prefix of all names in files of distributed training
_LORA_ALPHA = 16  # upstream's scale is min(rank, 16) / rank


def read_component(folder: Path, name: str) -> dict[str, Any]:
    """Read the file of a component, `NAME--STEP_checkpoint.pt`.

    Args:
        folder: The folder of the checkpoint.
        name: The name of the component, such as "action_head".

    Returns:
        The tensors by name.

    Raises:
        ConfigError: There is no such file, or there are several files.
    """
    files = sorted(path.name for path in folder.glob(f"{name}--*checkpoint.pt"))
    if len(files) != 1:
        have = sorted(path.name for path in folder.glob("*.pt"))
        raise ConfigError(
            f"checkpoint {folder}: expected one file {name}--STEP_checkpoint.pt, got "
            f"{files or have}; copy it there, or check `head`, `film` and `state` against how the "
            "checkpoint was trained"
        )
    saved = require("torch").load(folder / files[0], map_location="cpu", weights_only=True)
    return {key.removeprefix(_WRAPPED): tensor for key, tensor in saved.items()}


def require_unused(folder: Path, names: Iterable[str]) -> None:
    """Check that a checkpoint has no file of these components.

    Raises:
        ConfigError: There is a file of a component that the settings do not use.
    """
    for name in names:
        if any(folder.glob(f"{name}--*")):
            raise ConfigError(
                f"checkpoint {folder}: has {name}--…, which these settings do not use; set `head`, "
                "`film` and `state` to how the checkpoint was trained, or move the file away"
            )


def _require_layers(weights: Weights, layers: Iterable[str], component: str) -> Weights:
    """Return the weights of a component.

    Raise `ConfigError` unless they are exactly a weight and a bias for each layer.
    """
    expected: set[str] = set()
    for layer in layers:
        expected |= {f"{layer}.weight", f"{layer}.bias"}

    names = set(weights)
    if names != expected:
        raise ConfigError(
            f"{component}: expected {sorted(expected - names)}, got {sorted(names - expected)} in "
            "addition to the others; is it of a different kind?"
        )
    return weights


class Component:
    """A network that fine-tuning added to OpenVLA, stored as tensors by name."""

    weights: Weights  # upstream's name, which a learner pushes -> tensor
    _prefix = ""  # prefix of all names

    def to(self, device: Any, dtype: Any) -> Self:
        """Move the weights to a device, convert them to a type, and return the component."""
        self.weights = {name: tensor.to(device, dtype) for name, tensor in self.weights.items()}
        return self

    def _linear(self, layer: str, x: Any) -> Any:
        import torch  # torch's compiler follows an import statement, but not `require`

        return torch.nn.functional.linear(x, *self._weight_and_bias(layer))

    def _weight_and_bias(self, layer: str) -> tuple[Any, Any]:
        name = f"{self._prefix}{layer}"
        return self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]


class Mlp(Component):
    """A head: an MLP with residual blocks, applied to the hidden states of one row's action
    tokens.
    """

    def __init__(self, saved: Weights, prefix: str) -> None:
        layers = [f"{prefix}.{layer}" for layer in _MLP]
        self.weights = _require_layers(saved, layers, "action_head")
        self._prefix = f"{prefix}."

    @property
    def dim(self) -> int:
        """The number of outputs."""
        _, bias = self._weight_and_bias("fc2")
        return len(bias)

    def __call__(self, x: Any) -> Any:
        relu = require("torch").relu
        x = relu(self._linear("fc1", self._norm("layer_norm1", x)))
        for i in (0, 1):
            block = f"mlp_resnet_blocks.{i}.ffn"
            x = x + relu(self._linear(f"{block}.1", self._norm(f"{block}.0", x)))
        return self._linear("fc2", self._norm("layer_norm2", x))

    def _norm(self, layer: str, x: Any) -> Any:
        weight, bias = self._weight_and_bias(layer)
        return require("torch").nn.functional.layer_norm(x, bias.shape, weight, bias)


class Projector(Component):
    """A projection of numbers to embeddings of the language model: two layers with GELU between
    them.
    """

    def __init__(self, saved: Weights, name: str) -> None:
        self.weights = _require_layers(saved, ("fc1", "fc2"), name)

    @property
    def dim(self) -> int:
        """The number of inputs."""
        return int(self.weights["fc1.weight"].shape[1])

    def __call__(self, x: Any) -> Any:
        return self._linear("fc2", require("torch").nn.functional.gelu(self._linear("fc1", x)))


class Film(Component):
    """Vision backbones whose blocks are scaled and shifted by the instruction (arXiv
    1709.07871).
    """

    def __init__(self, saved: Weights, backbone: Any) -> None:
        """Use FiLM's tensors in `saved`, and load the other tensors into the backbone.

        Raises:
            ConfigError: The tensors do not fit the backbone.
        """
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

        self._vits = {}
        for name in ("featurizer", "fused_featurizer"):
            if hasattr(backbone, name):
                self._vits[name] = getattr(backbone, name)

        layers = []
        for name, vit in self._vits.items():
            for i in range(len(vit.blocks)):
                layers += [f"{name}.blocks.{i}.scale", f"{name}.blocks.{i}.shift"]
        self.weights = _require_layers(film, layers, "vision_backbone")

    def __call__(self, pixels: Any, language: Any) -> Any:
        """Return the features of the images' patches, conditioned on the instructions.

        Args:
            pixels: The images, (B, C, S, S), with three channels for each backbone.
            language: The mean of the embeddings of each instruction, (B, D).

        Returns:
            The features of the patches, (B, P, V).
        """
        import torch  # torch's compiler follows an import statement, but not `require`

        patches = []
        for name, channels in zip(self._vits, pixels.split(3, dim=1), strict=True):
            patches.append(self._encode(name, channels, language))
        return torch.cat(patches, dim=2)

    def _encode(self, name: str, pixels: Any, language: Any) -> Any:
        """Return the output of the second to last block, which OpenVLA uses."""
        vit = self._vits[name]
        x = vit.norm_pre(vit.patch_drop(vit._pos_embed(vit.patch_embed(pixels))))
        for i, block in enumerate(vit.blocks[:-1]):
            layer = f"{name}.blocks.{i}"
            scale = self._linear(f"{layer}.scale", language)[:, None]
            shift = self._linear(f"{layer}.shift", language)[:, None]
            x = x + block.ls1(block.attn(block.norm1(x)))
            x = x * (1 + scale) + shift
            x = x + block.ls2(block.mlp(block.norm2(x)))
        return x[:, vit.num_prefix_tokens :]


def _merged(saved: Weights) -> dict[str, Any]:
    """Add low-rank adapters, which OFT+ saves separately, to the weights of their layers, including
    convolutions.
    """
    merged = {}
    for name, tensor in saved.items():
        if ".lora_" not in name:
            merged[name.replace(".base_layer.", ".")] = tensor

    for name, down in saved.items():
        if ".lora_A." not in name:
            continue
        up = saved[name.replace(".lora_A.", ".lora_B.")]
        rank = len(down)
        scale = min(rank, _LORA_ALPHA) / rank
        added = up.flatten(1).float() @ down.flatten(1).float() * scale

        layer = name.partition(".lora_A.")[0] + ".weight"
        weight = merged[layer]
        merged[layer] = (weight.float() + added.view_as(weight)).to(weight.dtype)
    return merged
