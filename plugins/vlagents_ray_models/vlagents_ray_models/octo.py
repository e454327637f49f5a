"""Octo, with windows of real frames, tasks in words or as images, and the noise of each session."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import json
import re
import sys
import types
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.interface import GOAL_IMAGE, Obs
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.accelerator import jax_device
from vlagents_ray.policies.base.checkpoint import find_checkpoint, require_filled
from vlagents_ray.policies.base.model_inputs import camera_images, choose_cameras, state_vector
from vlagents_ray.registry import require
from vlagents_ray_models.model_code import CURE, remote_code, use_source


class OctoConfig(ModelConfig):
    """Settings of Octo, in addition to those of all models."""

    checkpoint: str = Field(
        min_length=1,
        description="folder of `save_pretrained` (its newest step, or `folder/{step}`), or hub id: "
        "org/name@COMMIT",
    )
    dtype: Literal["auto", "float32"] = Field(
        default="auto", description="float32, as Octo computes"
    )
    compile: Literal[True] = Field(
        default=True, description="JAX always compiles, once for each of `batch_sizes`"
    )
    source_dir: str | None = Field(
        default=None,
        description="a checkout of Octo; unset: the installed one, or the one that OCTO_SRC names",
    )
    trust_remote_code: bool = Field(
        default=False,
        description="load a checkpoint that names other code than Octo's components, which then "
        "runs with all rights "
        "of this process, or that has transformers run code from the hub",
    )

    dataset: str | None = Field(
        default=None,
        description="dataset whose statistics scale the actions, e.g. bridge_dataset; unset: the "
        "checkpoint's only one",
    )
    normalization: Literal["normal", "bounds"] = Field(
        default="normal",
        description="how training scaled actions: by mean and std, or from [p01, p99] to [-1, 1]",
    )
    window: int | None = Field(
        default=None,
        ge=1,
        description="largest number of observations that the model gets; unset: as in training",
    )
    crop: bool = Field(
        default=True,
        description="show the middle 90% of the primary camera's area, the average crop of the "
        "training, as Octo's "
        "ResizeImageWrapper does",
    )
    goal: Literal["either", "language", "image"] = Field(
        default="either",
        description="what makes a task: an instruction, an image in `info['goal_image']` at reset, "
        "or either",
    )


PRIMARY = "image_primary"  # the camera of goal images, which training crops
USUAL_CAMERAS = {PRIMARY: "front", "image_wrist": "wrist"}


class Octo(ModelPolicy):
    """The policy of an Octo checkpoint: a row for each session, with its window of frames and
    its noise.
    """

    Config: ClassVar[type] = OctoConfig
    config: OctoConfig
    trainable = "model.params"

    @property
    def history(self) -> int:
        network: OctoNetwork | None = self.model
        return self.config.window or (1 if network is None else network.window)

    @property
    def contract(self) -> Contract:
        instruction = {"language": True, "image": False}.get(self.config.goal)
        network: OctoNetwork | None = self.model
        if network is None:
            return Contract(instruction=instruction, history=self.config.window)
        action = _action(
            len(network.statistics(self.config.dataset, "action")["mean"]), self.config.dataset
        )
        cameras, parts, horizon = (
            self._cameras(network),
            self.config.state or (),
            network.head.action_horizon,
        )
        return self.stated(cameras, parts, horizon, instruction=instruction, action=action)

    @property
    def state_dim(self) -> int | None:
        return None if self.model is None else self.model.proprio_dim

    def load(self) -> OctoNetwork:
        config = self.config
        network = OctoNetwork.load(config)
        self._cameras(network)
        wanted = ("mean", "std") if config.normalization == "normal" else ("mean", "p01", "p99")
        statistics = network.statistics(config.dataset, "action")
        if absent := [name for name in wanted if name not in statistics]:
            raise ConfigError(
                f"normalization {config.normalization!r}: the statistics of {config.dataset!r} "
                f"have {sorted(statistics)}, not {absent}; set it as in training"
            )
        if config.window is not None and config.window > network.longest:
            raise ConfigError(
                f"window: got {config.window}, want at most {network.longest}; trained: "
                f"{network.window}"
            )
        if (network.proprio_dim is None) != (not config.state):
            need = (
                "reads no state"
                if network.proprio_dim is None
                else f"reads a state of {network.proprio_dim} numbers"
            )
            raise ConfigError(
                f"state: got {config.state}, but the checkpoint {need}; set it as in training"
            )
        if network.proprio_dim is not None:
            network.statistics(config.dataset, PROPRIO)
        return network

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode, whose task is `obs.info["goal_image"]` if there is one, else the
        instruction.
        """
        goal = self._goal(obs, instruction)
        info = super().reset(obs, instruction, **kwargs)
        if goal is not None:
            self._begun().memory[GOAL_IMAGE] = goal
        return info

    def perceive(self, obs: Obs) -> dict[str, np.ndarray]:
        network: OctoNetwork = self.model
        seen = {
            name: self._image(name, image)
            for name, image in camera_images(obs, self._cameras(network)).items()
        }
        if network.proprio_dim is not None:
            vector = state_vector(obs, self.config.state or (), network.proprio_dim)
            seen[PROPRIO] = normalised_state(
                vector, network.statistics(self.config.dataset, PROPRIO)
            )
        return seen

    def predict(self, rows: Sequence[Row]) -> list[Prediction]:
        """Compute the chunks, with one pass of the transformer per window and one of the action
        head per row.
        """
        network: OctoNetwork = self.model
        firsts, owners = self.observations_of(rows)
        asked = [rows[i] for i in firsts]
        keys = np.stack([row.rng.integers(2**32, size=2, dtype=np.uint32) for row in rows])
        statistics = network.statistics(self.config.dataset, "action")
        encoded = network.encode(self._observations(asked), self._tasks(asked))
        actions = network.decode(encoded, np.array(owners), keys, len(statistics["mean"]))
        return [
            Prediction(real_actions(chunk, statistics, self.config.normalization))
            for chunk in actions
        ]

    def _observations(self, rows: Sequence[Row]) -> dict[str, np.ndarray]:
        """Return windows (B, W, ...), padded with the first frame, which is masked there."""
        length = self.history
        histories = [row.history(length) for row in rows]
        observations = {
            name: np.stack([np.stack([frame[name] for frame in frames]) for frames in histories])
            for name in histories[0][0]
        }
        real = [min(len(row.frames), length) for row in rows]
        observations["timestep_pad_mask"] = np.arange(length) >= length - np.array(real)[:, None]
        return observations

    def _tasks(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the tasks of a batch: words with blank goal images, or goal images with blank
        words, with masks.
        """
        goals = [row.memory.get(GOAL_IMAGE) for row in rows]
        words = [
            row.instruction if goal is None else "" for row, goal in zip(rows, goals, strict=True)
        ]
        tasks: dict[str, Any] = self.model.model.create_tasks(texts=words)
        for i, goal in enumerate(goals):
            if goal is not None:
                tasks[PRIMARY][i] = goal
                tasks["pad_mask_dict"][PRIMARY][i] = True
                tasks["pad_mask_dict"]["language_instruction"][i] = False
        return tasks

    def _goal(self, obs: Obs, instruction: str | None) -> np.ndarray | None:
        goal, kind = obs.info.get(GOAL_IMAGE), self.config.goal
        if (goal is None and (kind == "image" or not instruction)) or (
            goal is not None and kind == "language"
        ):
            wanted = {"language": "an instruction", "image": f"info[{GOAL_IMAGE!r}]"}
            raise InvalidObservation(
                f"task: got {'no goal image' if goal is None else 'a goal image'} and the "
                f"instruction {instruction!r}, want "
                f"{wanted.get(kind, ' or '.join(wanted.values()))}; see the policy's `goal`"
            )
        if goal is None:
            return None
        if (
            not isinstance(goal, np.ndarray)
            or goal.ndim != 3
            or goal.shape[2] != 3
            or goal.dtype != np.uint8
        ):
            raise InvalidObservation(f"info[{GOAL_IMAGE!r}]: want (H, W, 3) uint8 RGB")
        return self._image(PRIMARY, goal)

    def _image(self, name: str, image: np.ndarray) -> np.ndarray:
        return resized(image, *self.model.cameras[name], crop=self.config.crop and name == PRIMARY)

    def _cameras(self, network: OctoNetwork) -> dict[str, str]:
        chosen, known = self.config.cameras, list(network.cameras)
        if chosen and set(chosen) <= set(known):
            return chosen  # Octo was trained with missing cameras, whose tokens it omits
        return choose_cameras(
            chosen, {name: ours for name, ours in USUAL_CAMERAS.items() if name in known}, known
        )


def _action(dim: int, dataset: str | None) -> ActionSpec:
    """Describe the actions of a pretraining dataset in its standard form; fine-tuned checkpoints do
    not state theirs.

    octo/data/oxe: change of the end effector's position and of its roll, pitch and yaw, then the
    gripper, 1 = open.
    """
    if dataset is None or dim != 7:
        return ActionSpec(dim=dim)
    return ActionSpec(
        dim=dim,
        space="ee_pose",
        delta=True,
        rotation="euler_xyz",
        gripper_open=1.0,
        gripper_closed=0.0,
    )


PROPRIO = "proprio"  # Octo's name of the state vector
_FILES = ("config.json", "example_batch.msgpack", "dataset_statistics.json")
_HEADS = (
    "DiffusionActionHead",
    "MSEActionHead",
    "L1ActionHead",
    "ContinuousActionHead",
    "DiscreteActionHead",
)
_EPSILON = 1e-8  # added to a standard deviation by Octo's NormalizeProprio


def octo_model_class(source_dir: str | None) -> Any:
    """Import `octo.model.octo_model.OctoModel`, from a checkout if one is given."""
    use_source("octo", "OCTO_SRC", source_dir)
    if "dlimp" not in sys.modules and importlib.util.find_spec("dlimp") is None:
        # Octo's data loaders import it; the model only uses a constant of their module.
        stub: Any = types.ModuleType("dlimp")
        stub.DLataset = object
        sys.modules["dlimp"] = stub
    # It only resizes images, and JAX needs the memory.
    require("tensorflow").config.set_visible_devices([], "GPU")
    return require("octo.model.octo_model").OctoModel


class OctoNetwork:
    """The model of a loaded checkpoint."""

    def __init__(self, model: Any, device: Any) -> None:
        """Compile an `OctoModel`, and move its parameters to a device once."""
        jax = require("jax")
        self.model = model
        self.params = jax.device_put(model.params, device)
        self.head = model.module.heads["action"]
        self.window: int = model.example_batch["observation"]["timestep_pad_mask"].shape[1]
        self.longest: int = model.module.octo_transformer.max_horizon
        self._decode = jax.jit(self._decoded, static_argnames="dim")
        self._encode = jax.jit(self._encoded)
        self._gather = jax.jit(
            lambda encoded, owners: jax.tree_util.tree_map(lambda one: one[owners], encoded)
        )

    @classmethod
    def load(cls, config: OctoConfig) -> OctoNetwork:
        """Read a checkpoint; raises `ConfigError` if it is incomplete, or names code that is not
        Octo's.
        """
        octo_model = octo_model_class(config.source_dir)
        folder, step = _folder_and_step(config.checkpoint, config.checkpoint_step)
        chosen = jax_device(config.device)
        if not config.trust_remote_code:
            require_own_classes(folder / _FILES[0])
        try:
            with remote_code(allowed=config.trust_remote_code):
                model = octo_model.load_pretrained(str(folder), step)
        except ConfigError:
            raise
        except (OSError, ValueError, KeyError) as error:
            raise ConfigError(
                f"checkpoint {folder}: Octo could not load it ({type(error).__name__}: {error}); "
                "is it complete, of this version of Octo, and is its language encoder's tokenizer "
                "on the hub or in the cache?"
            ) from error
        network, example, jax = cls(model, chosen), model.example_batch, require("jax")
        init = partial(model.module.init, train=False)
        inputs = (
            example["observation"],
            example["task"],
            example["observation"]["timestep_pad_mask"],
        )
        require_filled(model.params, jax.eval_shape(init, jax.random.PRNGKey(0), *inputs)["params"])
        if type(network.head).__name__ not in _HEADS:
            raise ConfigError(
                f"action head: got {type(network.head).__name__}, want one of {list(_HEADS)}"
            )
        return network

    @cached_property
    def cameras(self) -> dict[str, tuple[int, int]]:
        """The height and width of each image that a tokenizer reads, by Octo's name."""
        found = self._read_by("ImageTokenizer", "obs_stack_keys", ("image_.*",))
        return {
            name: (shape[0], shape[1]) for name, shape in found.items() if name.startswith("image_")
        }

    @cached_property
    def proprio_dim(self) -> int | None:
        """The length of the state vector; None if no tokenizer reads it."""
        found = self._read_by("LowdimObsTokenizer", "obs_keys", ())
        return found[PROPRIO][0] if PROPRIO in found else None

    def statistics(self, dataset: str | None, part: str) -> dict[str, np.ndarray]:
        """Return the statistics of "action" or "proprio"; raises `ConfigError` if there are
        none.
        """
        have = self.model.dataset_statistics
        own = have if dataset is None else have.get(dataset, {})
        if part not in own:
            choices = sorted(
                name for name, value in have.items() if isinstance(value, Mapping) and part in value
            )
            raise ConfigError(
                f"dataset {dataset!r}: the checkpoint has no statistics of {part!r} for it, so its "
                "numbers have "
                "no units; want "
                f"{f'one of {choices}' if choices else 'a checkpoint with dataset_statistics.json'}"
                f"{', or none' if part in have else ''}"
            )
        return {name: np.asarray(values) for name, values in own[part].items()}

    def encode(
        self, observations: Mapping[str, np.ndarray], tasks: Mapping[str, Any]
    ) -> tuple[Any, Any]:
        """Compute the inputs of the action head on the device: tokens (P, W, N, E) and their
        mask (P, W, N).
        """
        encoded: tuple[Any, Any] = self._encode(self.params, observations, tasks)
        return encoded

    def decode(
        self, encoded: tuple[Any, Any], owners: np.ndarray, keys: np.ndarray, dim: int
    ) -> np.ndarray:
        """Sample normalised actions (B, H, dim) from `encode` of `owners` (B,), with random keys
        (B, 2) uint32.
        """
        tokens, mask = encoded if len(encoded[0]) == len(owners) else self._gather(encoded, owners)
        return np.asarray(self._decode(self.params, tokens, mask, keys, dim=dim))

    def _encoded(self, params: Any, observations: Any, tasks: Any) -> Any:
        pad_mask = observations["timestep_pad_mask"]
        outputs = self.model.module.apply(
            {"params": params},
            observations,
            tasks,
            pad_mask,
            train=False,
            method="octo_transformer",
        )
        read = outputs[self.head.readout_key]
        return read.tokens, read.mask

    def _decoded(self, params: Any, tokens: Any, mask: Any, keys: Any, dim: int) -> Any:
        group = require("octo.model.components.base").TokenGroup
        head = self.model.module.bind({"params": params}).heads["action"]

        def alone(tokens: Any, mask: Any, key: Any) -> Any:
            read = {head.readout_key: group(tokens[None], mask[None])}
            return head.predict_action(read, train=False, rng=key, embodiment_action_dim=dim)[0]

        return require("jax").vmap(alone)(tokens, mask, keys)[..., :dim]

    def _read_by(
        self, tokenizer: str, setting: str, usual: tuple[str, ...]
    ) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the parts of an observation that match the patterns of one kind
        of tokenizer.
        """
        specs = [
            s
            for s in self.model.config["model"]["observation_tokenizers"].values()
            if s["name"] == tokenizer
        ]
        patterns = [pattern for spec in specs for pattern in spec["kwargs"].get(setting, usual)]
        return {
            name: tuple(array.shape[2:])
            for name, array in self.model.example_batch["observation"].items()
            if any(re.match(pattern, name) for pattern in patterns)
        }


def normalised_state(vector: np.ndarray, statistics: Mapping[str, np.ndarray]) -> np.ndarray:
    """Normalise the state, (P,) float32, as Octo's NormalizeProprio does."""
    scaled = (vector - statistics["mean"]) / (statistics["std"] + _EPSILON)
    return np.where(statistics.get("mask", True), scaled, vector).astype(np.float32)


def real_actions(
    actions: np.ndarray, statistics: Mapping[str, np.ndarray], normalization: str
) -> np.ndarray:
    """Convert normalised actions (..., D) to the units of the data, float32; masked-out numbers
    stay unchanged.
    """
    if normalization == "normal":
        scaled = actions * statistics["std"] + statistics["mean"]
    else:
        low, high = statistics["p01"], statistics["p99"]
        scaled = (actions + 1) * (high - low) / 2 + low
    return np.where(statistics.get("mask", True), scaled, actions).astype(np.float32)


def _folder_and_step(checkpoint: str, step: int | None) -> tuple[Path, int]:
    """Return the folder with the configuration and the step within it, by default the newest."""
    folder = find_checkpoint(checkpoint.removeprefix("hf://"), step)
    if folder.name.isdigit() and not (folder / _FILES[0]).exists():
        folder, step = folder.parent, int(folder.name)
    find_checkpoint(str(folder), needs=_FILES)
    steps = sorted(int(p.name) for p in folder.iterdir() if p.is_dir() and p.name.isdigit())
    if not steps:
        raise ConfigError(
            f"checkpoint {folder}: has no step, a folder with a number for a name; copy all of it"
        )
    step = steps[-1] if step is None else step
    for part in (*_FILES, str(step)):  # the files of the weights; training adds further steps
        find_checkpoint(str(folder / part))
    return folder, step


_PARTS = "octo.model.components."  # tokenizers, encoders, action heads
_TEXT = "octo.data.utils.text_processing"


def require_own_classes(file: Path) -> None:
    """Raise `ConfigError` unless a config.json names only classes of Octo's components and text
    processors.

    Other classes are not imported, since Octo accepts any callable of any module, including
    `os.system`.
    """
    try:
        config = json.loads(file.read_text(encoding="utf-8"))
        loaded = {name: config[name] for name in ("model", "text_processor")}
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{file}: not a configuration of Octo's ({type(error).__name__}: {error})"
        ) from error
    named = [(spec["module"], spec["name"]) for spec in _specs(loaded)]
    for is_own in (_is_own_name, _is_own_class):  # check all names before importing anything
        for module, name in named:
            if not is_own(module, name):
                raise ConfigError(
                    f"{file}: names {name!r} of {module!r}, want a class of {_PARTS}* or {_TEXT}: "
                    f"loading the checkpoint would run that, whatever it is; {CURE}"
                )


def _specs(value: object) -> Iterator[Mapping[str, Any]]:
    if isinstance(value, Mapping):
        if "module" in value and "name" in value:
            yield value
        for one in value.values():
            yield from _specs(one)
    elif isinstance(value, list):
        for one in value:
            yield from _specs(one)


def _is_own_name(module: object, name: object) -> bool:
    if not isinstance(module, str) or not isinstance(name, str) or not name.isidentifier():
        return False
    return module == _TEXT or module.startswith(_PARTS)


def _is_own_class(module: str, name: str) -> bool:
    """Return whether Octo defines a class itself, rather than importing it into its module."""
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ImportError as error:
        raise ConfigError(
            f"{module}: this Octo does not have it ({error}); is the checkpoint of this version?"
        ) from error
    return inspect.isclass(found) and found.__module__.startswith("octo.")


# Share of each side, from the average area of training's random crops.
_CROPPED = np.sqrt(np.float32(0.9))


def resized(image: np.ndarray, height: int, width: int, *, crop: bool) -> np.ndarray:
    """Resize an (H, W, 3) uint8 image to (height, width, 3) by Lanczos, from its centre if
    `crop`; returns a copy.
    """
    if not crop and image.shape[:2] == (height, width):
        return image.copy()  # the filter would change nothing
    tf = require("tensorflow")
    found = tf.image.resize(image, (height, width), method="lanczos3", antialias=True)
    if crop:
        edge = (np.float32(1) - _CROPPED) / 2
        box = [[edge, edge, edge + _CROPPED, edge + _CROPPED]]
        found = tf.image.crop_and_resize(found[None], box, [0], (height, width))[0]
    return np.asarray(tf.cast(tf.clip_by_value(tf.round(found), 0, 255), tf.uint8))
