"""The policy Octo.

Each session has its own window of frames, its own task, as text or as an image, and its own noise.
"""

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
from vlagents_ray.errors import ConfigError, InvalidObservation, shown
from vlagents_ray.interface import GOAL_IMAGE, Obs
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.accelerator import jax_device
from vlagents_ray.policies.base.checkpoint import find_checkpoint, require_filled
from vlagents_ray.policies.base.model_inputs import camera_images, choose_cameras, state_vector
from vlagents_ray.registry import require
from vlagents_ray_models.model_code import CURE, remote_code, use_source


class OctoConfig(ModelConfig):
    """Settings of Octo, in addition to the settings of all models."""

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
        "runs with all rights of this process, or that has transformers run code from the hub",
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
        "training, as Octo's ResizeImageWrapper does",
    )
    goal: Literal["either", "language", "image"] = Field(
        default="either",
        description="what makes a task: an instruction, an image in `info['goal_image']` at reset, "
        "or either",
    )


PRIMARY = "image_primary"  # camera of goal images, which training crops
USUAL_CAMERAS = {PRIMARY: "front", "image_wrist": "wrist"}


class Octo(ModelPolicy):
    """The policy of an Octo checkpoint. Each session has a row with its own window of frames and
    its own noise.
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
        """The contract of the checkpoint. Before the checkpoint is loaded, it declares only the
        configured tasks and window.
        """
        instruction = {"language": True, "image": False}.get(self.config.goal)
        network: OctoNetwork | None = self.model
        if network is None:
            return Contract(instruction=instruction, history=self.config.window)

        dim = len(network.statistics(self.config.dataset, "action")["mean"])
        return self.make_contract(
            self._cameras(network),
            self.config.state or (),
            network.head.action_horizon,
            instruction=instruction,
            action=_action_spec(dim, self.config.dataset),
        )

    @property
    def state_dim(self) -> int | None:
        return None if self.model is None else self.model.proprio_dim

    def load(self) -> OctoNetwork:
        """Read the checkpoint; raises `ConfigError` for settings that do not fit it."""
        config = self.config
        network = OctoNetwork.load(config)
        self._cameras(network)  # raises an error unless the configured cameras fit
        needed = ("mean", "std") if config.normalization == "normal" else ("mean", "p01", "p99")
        statistics = network.statistics(config.dataset, "action")
        absent = [name for name in needed if name not in statistics]
        if absent:
            raise ConfigError(
                f"normalization {config.normalization!r}: the statistics of {config.dataset!r} "
                f"have {sorted(statistics)}, not {absent}; set it as in training"
            )
        if config.window is not None and config.window > network.longest:
            raise ConfigError(
                f"window: expected at most {network.longest}, got {config.window}; set "
                f"{network.window}, as in training"
            )

        if (network.proprio_dim is None) != (not config.state):
            needed_state = (
                "no state"
                if network.proprio_dim is None
                else f"a state of {network.proprio_dim} numbers"
            )
            raise ConfigError(
                f"state: expected {needed_state}, got {config.state}; set it as in training"
            )
        if network.proprio_dim is not None:
            # Raises an error if there are no statistics.
            network.statistics(config.dataset, PROPRIO)
        return network

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode.

        Its task is `obs.info["goal_image"]` if there is one, otherwise the instruction.
        """
        goal = self._goal(obs, instruction)
        info = super().reset(obs, instruction, **kwargs)
        if goal is not None:
            self._current_episode().memory[GOAL_IMAGE] = goal
        return info

    def perceive(self, obs: Obs) -> dict[str, np.ndarray]:
        """Return the images, (H, W, 3) uint8, and the normalised state, (D,) float32, under Octo's
        names.
        """
        network: OctoNetwork = self.model
        inputs: dict[str, np.ndarray] = {}
        for name, image in camera_images(obs, self._cameras(network)).items():
            inputs[name] = self._image(name, image)

        if network.proprio_dim is not None:
            vector = state_vector(obs, self.config.state or (), network.proprio_dim)
            statistics = network.statistics(self.config.dataset, PROPRIO)
            inputs[PROPRIO] = normalised_state(vector, statistics)
        return inputs

    def predict(self, rows: Sequence[Row]) -> list[Prediction]:
        """Compute the chunks, in one pass of the transformer for all windows and one pass of the
        action head for all rows.
        """
        network: OctoNetwork = self.model
        firsts, owners = self.observations_of(rows)
        encoded_rows = [rows[i] for i in firsts]
        keys = np.stack([row.rng.integers(2**32, size=2, dtype=np.uint32) for row in rows])

        encoded = network.encode(self._observations(encoded_rows), self._tasks(encoded_rows))
        statistics = network.statistics(self.config.dataset, "action")
        chunks = network.decode(encoded, np.array(owners), keys, len(statistics["mean"]))
        normalization = self.config.normalization
        return [Prediction(real_actions(chunk, statistics, normalization)) for chunk in chunks]

    def _observations(self, rows: Sequence[Row]) -> dict[str, np.ndarray]:
        """Return windows of observations by name, (B, W, …), with "timestep_pad_mask" (B, W).

        If there are too few frames, a window begins with masked copies of its first frame.
        """
        length = self.history
        histories = [row.history(length) for row in rows]
        observations: dict[str, np.ndarray] = {}
        for name in histories[0][0]:
            windows = []
            for frames in histories:
                windows.append(np.stack([frame[name] for frame in frames]))
            observations[name] = np.stack(windows)

        real_lengths = np.array([min(len(row.frames), length) for row in rows])
        observations["timestep_pad_mask"] = np.arange(length) >= length - real_lengths[:, None]
        return observations

    def _tasks(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the tasks of a batch and their masks: texts with blank goal images, or goal images
        with blank texts.
        """
        goals = [row.memory.get(GOAL_IMAGE) for row in rows]
        texts = []
        for row, goal in zip(rows, goals, strict=True):
            texts.append(row.instruction if goal is None else "")

        tasks: dict[str, Any] = self.model.model.create_tasks(texts=texts)
        for i, goal in enumerate(goals):
            if goal is not None:
                tasks[PRIMARY][i] = goal
                tasks["pad_mask_dict"][PRIMARY][i] = True
                tasks["pad_mask_dict"]["language_instruction"][i] = False
        return tasks

    def _goal(self, obs: Obs, instruction: str | None) -> np.ndarray | None:
        """Return the goal image at the model's size; None if the instruction is the task.

        Raises:
            InvalidObservation: There is no task of the configured kind, or the goal is not a valid
                image.
        """
        goal = obs.info.get(GOAL_IMAGE)
        task = self.config.goal
        accepts_words = task != "image" and bool(instruction)
        accepts_image = task != "language"
        if not (accepts_words if goal is None else accepts_image):
            tasks = {"language": "an instruction", "image": f"info[{GOAL_IMAGE!r}]"}
            expected = tasks.get(task, " or ".join(tasks.values()))
            raise InvalidObservation(
                f"task: expected {expected}, got "
                f"{'no goal image' if goal is None else 'a goal image'} and the instruction "
                f"{instruction!r}; see the policy's `goal`"
            )

        if goal is None:
            return None
        if (
            not isinstance(goal, np.ndarray)
            or goal.ndim != 3
            or goal.shape[2] != 3
            or goal.dtype != np.uint8
        ):
            raise InvalidObservation(
                f"info[{GOAL_IMAGE!r}]: expected (H, W, 3) uint8 RGB, got {shown(goal)}"
            )
        return self._image(PRIMARY, goal)

    def _image(self, name: str, image: np.ndarray) -> np.ndarray:
        height, width = self.model.cameras[name]
        return resized(image, height, width, crop=self.config.crop and name == PRIMARY)

    def _cameras(self, network: OctoNetwork) -> dict[str, str]:
        """Return our camera for each image that the model gets."""
        chosen = self.config.cameras
        names = list(network.cameras)
        if chosen and set(chosen) <= set(names):
            # Octo was also trained without some cameras, and omits the tokens of missing ones.
            return chosen
        usual = {name: ours for name, ours in USUAL_CAMERAS.items() if name in names}
        return choose_cameras(chosen, usual, names)


def _action_spec(dim: int, dataset: str | None) -> ActionSpec:
    """Describe the actions of a pretraining dataset, which have a standard form.

    The form is defined in octo/data/oxe: the change of the end effector's position and of its roll,
    pitch and yaw, then the gripper, 1 = open. Fine-tuned checkpoints do not declare the form of
    their actions.
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
    """Import `octo.model.octo_model.OctoModel`.

    Args:
        source_dir: A checkout of Octo. With None, the checkout that OCTO_SRC names or the installed
            Octo is used.

    Raises:
        ConfigError: Octo is not found.
    """
    use_source("octo", "OCTO_SRC", source_dir)
    if "dlimp" not in sys.modules and importlib.util.find_spec("dlimp") is None:
        # Octo's data loaders import it; the model only uses a constant of their module.
        stub: Any = types.ModuleType("dlimp")
        stub.DLataset = object
        sys.modules["dlimp"] = stub
    # TensorFlow only resizes images, and must leave the memory of the GPU to JAX.
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
        # Numbers of observations: in training, and at most, according to the model's positions.
        self.window: int = model.example_batch["observation"]["timestep_pad_mask"].shape[1]
        self.longest: int = model.module.octo_transformer.max_horizon

        self._decode = jax.jit(self._decoded, static_argnames="dim")
        self._encode = jax.jit(self._encoded)
        self._gather = jax.jit(self._gathered)

    @classmethod
    def load(cls, config: OctoConfig) -> OctoNetwork:
        """Read a checkpoint.

        Raises:
            ConfigError: The checkpoint is incomplete, or names code outside of Octo that is not
                trusted.
        """
        octo_model = octo_model_class(config.source_dir)
        folder, step = _folder_and_step(config.checkpoint, config.checkpoint_step)
        device = jax_device(config.device)
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

        jax = require("jax")
        network = cls(model, device)
        observation = model.example_batch["observation"]
        inputs = (observation, model.example_batch["task"], observation["timestep_pad_mask"])
        init = partial(model.module.init, train=False)
        shapes = jax.eval_shape(init, jax.random.PRNGKey(0), *inputs)["params"]
        require_filled(model.params, shapes)
        if type(network.head).__name__ not in _HEADS:
            raise ConfigError(
                f"action head: expected one of {list(_HEADS)}, got {type(network.head).__name__}"
            )
        return network

    @cached_property
    def cameras(self) -> dict[str, tuple[int, int]]:
        """The height and width of each image that a tokenizer reads, under Octo's name."""
        shapes = self._shapes_read_by("ImageTokenizer", "obs_stack_keys", ("image_.*",))
        cameras: dict[str, tuple[int, int]] = {}
        for name, shape in shapes.items():
            if name.startswith("image_"):
                cameras[name] = (shape[0], shape[1])
        return cameras

    @cached_property
    def proprio_dim(self) -> int | None:
        """The length of the state vector; None if no tokenizer reads it."""
        shapes = self._shapes_read_by("LowdimObsTokenizer", "obs_keys", ())
        return shapes[PROPRIO][0] if PROPRIO in shapes else None

    def statistics(self, dataset: str | None, name: str) -> dict[str, np.ndarray]:
        """Return statistics of the checkpoint.

        Args:
            dataset: The dataset; None selects the checkpoint's only dataset.
            name: "action" or "proprio".

        Returns:
            An array (D,) for each statistic, such as "mean".

        Raises:
            ConfigError: The checkpoint has no such statistics.
        """
        by_dataset = self.model.dataset_statistics
        by_name = by_dataset if dataset is None else by_dataset.get(dataset, {})
        if name not in by_name:
            choices = []
            for dataset_name in sorted(by_dataset):
                statistics = by_dataset[dataset_name]
                if isinstance(statistics, Mapping) and name in statistics:
                    choices.append(dataset_name)
            expected = (
                f"one of {choices}" if choices else "a checkpoint with dataset_statistics.json"
            )
            raise ConfigError(
                f"dataset: expected {expected}{', or none' if name in by_dataset else ''}, got "
                f"{dataset!r}, for which the checkpoint has no statistics of {name!r}, so that "
                "its numbers have no units"
            )
        return {statistic: np.asarray(values) for statistic, values in by_name[name].items()}

    def encode(
        self, observations: Mapping[str, np.ndarray], tasks: Mapping[str, Any]
    ) -> tuple[Any, Any]:
        """Compute the inputs of the action head.

        Args:
            observations: Windows (P, W, …) of P observations by name, with "timestep_pad_mask".
            tasks: Their tasks, as `create_tasks` of the model returns them.

        Returns:
            The tokens (P, W, N, E) and their mask (P, W, N), on the device.
        """
        encoded: tuple[Any, Any] = self._encode(self.params, observations, tasks)
        return encoded

    def decode(
        self, encoded: tuple[Any, Any], owners: np.ndarray, keys: np.ndarray, dim: int
    ) -> np.ndarray:
        """Sample normalised actions.

        Args:
            encoded: The result of `encode` for P observations.
            owners: (B,) int, the observation of each row.
            keys: (B, 2) uint32, the random key of each row.
            dim: The number of values of an action.

        Returns:
            The actions, (B, H, dim).
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
        readout = outputs[self.head.readout_key]
        return readout.tokens, readout.mask

    @staticmethod
    def _gathered(encoded: Any, owners: Any) -> Any:
        return require("jax").tree_util.tree_map(lambda array: array[owners], encoded)

    def _decoded(self, params: Any, tokens: Any, mask: Any, keys: Any, dim: int) -> Any:
        token_group = require("octo.model.components.base").TokenGroup
        head = self.model.module.bind({"params": params}).heads["action"]

        def decode_row(tokens: Any, mask: Any, key: Any) -> Any:
            readouts = {head.readout_key: token_group(tokens[None], mask[None])}
            return head.predict_action(readouts, train=False, rng=key, embodiment_action_dim=dim)[0]

        return require("jax").vmap(decode_row)(tokens, mask, keys)[..., :dim]

    def _shapes_read_by(
        self, tokenizer: str, setting: str, usual: tuple[str, ...]
    ) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the arrays that a class of tokenizers reads from an observation.

        Args:
            tokenizer: The name of the class.
            setting: The tokenizer's setting with the patterns of the arrays' names.
            usual: The patterns for tokenizers without the setting.
        """
        patterns: list[str] = []
        for spec in self.model.config["model"]["observation_tokenizers"].values():
            if spec["name"] == tokenizer:
                patterns += spec["kwargs"].get(setting, usual)

        shapes: dict[str, tuple[int, ...]] = {}
        for name, array in self.model.example_batch["observation"].items():
            if any(re.match(pattern, name) for pattern in patterns):
                shapes[name] = tuple(array.shape[2:])
        return shapes


def normalised_state(vector: np.ndarray, statistics: Mapping[str, np.ndarray]) -> np.ndarray:
    """Normalise a state as Octo's NormalizeProprio does.

    Args:
        vector: The state, (P,) float32.
        statistics: Its "mean", its "std" and perhaps a "mask", (P,) each.

    Returns:
        The normalised state, (P,) float32. Numbers outside of the mask stay unchanged.
    """
    scaled = (vector - statistics["mean"]) / (statistics["std"] + _EPSILON)
    return np.where(statistics.get("mask", True), scaled, vector).astype(np.float32)


def real_actions(
    actions: np.ndarray, statistics: Mapping[str, np.ndarray], normalization: str
) -> np.ndarray:
    """Convert normalised actions to the units of the data.

    Args:
        actions: Normalised actions, (..., D).
        statistics: Their statistics and perhaps a "mask", (D,) each.
        normalization: "normal", or "bounds", as in `OctoConfig`.

    Returns:
        The actions, (..., D) float32. Numbers outside of the mask stay unchanged.
    """
    if normalization == "normal":
        scaled = actions * statistics["std"] + statistics["mean"]
    else:
        low, high = statistics["p01"], statistics["p99"]
        scaled = (actions + 1) * (high - low) / 2 + low
    return np.where(statistics.get("mask", True), scaled, actions).astype(np.float32)


def _folder_and_step(checkpoint: str, step: int | None) -> tuple[Path, int]:
    """Return the folder with the configuration, and the step in that folder, by default the
    newest step.
    """
    folder = find_checkpoint(checkpoint.removeprefix("hf://"), step)
    if folder.name.isdigit() and not (folder / _FILES[0]).exists():
        folder, step = folder.parent, int(folder.name)
    find_checkpoint(str(folder), needs=_FILES)
    steps = []
    for path in folder.iterdir():
        if path.is_dir() and path.name.isdigit():
            steps.append(int(path.name))
    if not steps:
        raise ConfigError(
            f"checkpoint {folder}: expected a step, a folder with a number for a name, got none; "
            "copy all of it"
        )
    if step is None:
        step = max(steps)
    # Only these files identify the checkpoint, since training adds further steps to the folder.
    for name in (*_FILES, str(step)):
        find_checkpoint(str(folder / name))
    return folder, step


_COMPONENTS = "octo.model.components."  # package of tokenizers, encoders and action heads
_TEXT_PROCESSING = "octo.data.utils.text_processing"


def require_own_classes(file: Path) -> None:
    """Raise `ConfigError` unless all classes in a config.json are Octo's components and text
    processors.

    Other classes are not imported, since Octo accepts any callable of any module, including
    `os.system`.

    Args:
        file: The config.json of a checkpoint.
    """
    try:
        config = json.loads(file.read_text(encoding="utf-8"))
        sections = {name: config[name] for name in ("model", "text_processor")}
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{file}: not a configuration of Octo's ({type(error).__name__}: {error})"
        ) from error

    classes = [(spec["module"], spec["name"]) for spec in _specs(sections)]
    # All names are checked before anything is imported.
    for is_own in (_is_own_name, _is_own_class):
        for module, name in classes:
            if not is_own(module, name):
                raise ConfigError(
                    f"{file}: expected a class of {_COMPONENTS}* or {_TEXT_PROCESSING}, got "
                    f"{name!r} of {module!r}, which loading the checkpoint would run, whatever it "
                    f"is; {CURE}"
                )


def _specs(value: object) -> Iterator[Mapping[str, Any]]:
    """Yield each class specification in a configuration, at any depth."""
    if isinstance(value, Mapping):
        if "module" in value and "name" in value:
            yield value
        for nested in value.values():
            yield from _specs(nested)
    elif isinstance(value, list):
        for nested in value:
            yield from _specs(nested)


def _is_own_name(module: object, name: object) -> bool:
    """Return whether a module of Octo's components or text processors may contain the name."""
    if not isinstance(module, str) or not isinstance(name, str) or not name.isidentifier():
        return False
    return module == _TEXT_PROCESSING or module.startswith(_COMPONENTS)


def _is_own_class(module: str, name: str) -> bool:
    """Return whether Octo defines a class itself, rather than importing it into its module."""
    try:
        value = getattr(importlib.import_module(module), name, None)
    except ImportError as error:
        raise ConfigError(
            f"{module}: this Octo does not have it ({error}); is the checkpoint of this version?"
        ) from error
    return inspect.isclass(value) and value.__module__.startswith("octo.")


# The share of each side that is shown. Its square is the average area of the random crops in
# training.
_CROP_SIDE = np.sqrt(np.float32(0.9))


def resized(image: np.ndarray, height: int, width: int, *, crop: bool) -> np.ndarray:
    """Resize an image with a Lanczos filter, as Octo does.

    Args:
        image: The image, (H, W, 3) uint8.
        height: The height of the result, px.
        width: The width of the result, px.
        crop: Whether to show only the centre of the image.

    Returns:
        A copy, (height, width, 3) uint8.
    """
    if not crop and image.shape[:2] == (height, width):
        return image.copy()  # The filter would change nothing.

    tf = require("tensorflow")
    scaled = tf.image.resize(image, (height, width), method="lanczos3", antialias=True)
    if crop:
        margin = (np.float32(1) - _CROP_SIDE) / 2
        box = [[margin, margin, margin + _CROP_SIDE, margin + _CROP_SIDE]]
        scaled = tf.image.crop_and_resize(scaled[None], box, [0], (height, width))[0]
    return np.asarray(tf.cast(tf.clip_by_value(tf.round(scaled), 0, 255), tf.uint8))
