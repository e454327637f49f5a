"""A ManiSkill simulator with one environment or several."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract
from vlagents_ray.envs.maniskill import factory
from vlagents_ray.envs.maniskill.factory import instruction_for
from vlagents_ray.envs.maniskill.robot import ManiSkillRobot, action_spec
from vlagents_ray.envs.rendering.graphics import Renderer, vulkan_renderer
from vlagents_ray.envs.rendering.render_probe import failing, vulkan_device
from vlagents_ray.envs.simulator import Size, require_cameras
from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.interface import HIGH_RES, Obs
from vlagents_ray.registry import require


@dataclass(frozen=True, slots=True)
class Moment:
    """The result of a reset or step, with a row for each environment."""

    obs: list[Obs]
    success: list[bool]
    rewards: list[float]


class Simulator:
    """The `num_envs` environments of a task, each of which continues after success."""

    def __init__(
        self,
        name: str,
        task: str,
        *,
        obs_mode: str,
        num_envs: int = 1,
        cameras: Sequence[str] | None = None,
        record_size: Size | None = None,
        sim_backend: str,
        render_backend: str = "auto",
        control_mode: str | None = None,
        reward_mode: str | None = None,
        sensors: Mapping[str, Any],
    ) -> None:
        """`name` stands in errors. Raises `ConfigError`, or `EnvFailed` with its cure."""
        self.name = name
        self._task = task
        self._asked_for = render_backend != "auto"
        self._record: RecordCameras | None = None
        self.env: Any = factory.make(
            task,
            control_mode,
            num_envs=num_envs,
            obs_mode=obs_mode,
            reward_mode=reward_mode,
            sim_backend=sim_backend,
            render_backend=factory.render_backend(render_backend),
            sensor_configs=dict(sensors),
        )
        try:
            self._check_usable()
            self.cameras = self._choose(cameras)
            self._robot = ManiSkillRobot(self.env.agent)
        except BaseException:
            self.close()
            raise
        if record_size is not None:
            self._record = RecordCameras(record_size, self.cameras)

    @property
    def action(self) -> ActionSpec:
        """The specification of the control mode's actions."""
        env = self.alive()
        return action_spec(env.control_mode, env.single_action_space, has_gripper=self._robot.has_gripper)

    def contract(self, action: ActionSpec) -> Contract:
        """Return the contract of each environment, with these actions."""
        return Contract(
            cameras=self.cameras,
            state=self._robot.gives,
            gripper=self._robot.has_gripper,
            instruction=True,
            action=action,
            control_hz=float(self.alive().control_freq),
        )

    def instructions(self) -> list[str]:
        """The task in words, for each environment."""
        env = self.alive()
        own = getattr(env, "get_language_instruction", None)
        return [str(text) for text in own()] if own is not None else [instruction_for(self._task)] * env.num_envs

    def reset(self, seeds: Sequence[int], options: Mapping[str, Any]) -> Moment:
        """Begin an episode in each environment; seeds are taken modulo 2^32."""
        env = self.alive()
        with failing(self.name, "reset"):
            raw, info = env.reset(seed=[seed % 2**32 for seed in seeds], options=dict(options))
            if env.num_envs == 1:  # rendering is most of a step's time, so only the requested cameras are rendered
                for name in set(env.scene.sensors) - set(self.cameras):
                    del env.scene.sensors[name]
            return self.moment(raw, info)

    def reset_each(self, seeds: Sequence[int], options: Sequence[Mapping[str, Any]]) -> Moment:
        """Begin the episode of each environment separately, in the existing scenes.

        ManiSkill seeds torch once for all environments that it resets together, by the first one's seed. What a task
        draws by torch would then depend on the other environments.
        """
        env = self.alive()
        with failing(self.name, "reset"):
            with self._observing("none"):  # nothing is rendered before all episodes have begun
                for i, (seed, option) in enumerate(zip(seeds, options, strict=True)):
                    only = require("torch").tensor([i], device=env.device)
                    env.reset(seed=[seed % 2**32] * env.num_envs, options={**option, "env_idx": only})
            info = env.get_info()
            return self.moment(env.get_obs(info), info)

    def step(self, actions: np.ndarray, *, look: bool = True) -> Moment:
        """Execute one action in each environment, (N, D) float32; without `look` nothing is rendered."""
        env = self.alive()
        with failing(self.name, "step"), contextlib.nullcontext() if look else self._observing("state_dict"):
            # a copy: torch shares the memory, and warns of read-only arrays, such as those of Ray
            raw, rewards, _, _, info = env.step(actions.copy())
            return replace(self.moment(raw, info), rewards=rewards.cpu().numpy().astype(float).tolist())

    def moment(self, raw: Mapping[str, Any], info: Mapping[str, Any]) -> Moment:
        """Convert ManiSkill's observation and info. The images of a camera share one array, (N, H, W, 3)."""
        env = self.alive()
        rendered = raw.get("sensor_data")
        shown = {} if rendered is None else {name: rendered[name]["rgb"] for name in self.cameras}
        images = {name: np.ascontiguousarray(image.cpu().numpy()) for name, image in shown.items()}
        states = raw["state"].cpu().numpy() if "state" in raw else None
        seen = []
        for i, (state, gripper) in enumerate(self._robot.read(env.agent)):
            extra = {} if states is None else {"sim_state": states[i]}
            seen.append(Obs({name: rows[i] for name, rows in images.items()}, gripper, state, extra))
        if self._record is not None and rendered is not None:
            seen[0].info[HIGH_RES] = self._record.views(env)
        success = [bool(value) for value in info["success"]]
        return Moment(seen, success, [0.0] * len(seen))

    def renderer(self) -> Renderer | None:
        """The Vulkan device that draws."""
        found = vulkan_device(on_gpu=self.alive().backend.render_device.is_cuda())
        return None if found is None else vulkan_renderer(found.name, found.cuda, asked_for=self._asked_for)

    def describe(self) -> dict[str, Any]:
        """Versions, backends and modes, for the record."""
        env = self.alive()
        return {
            "simulator": "maniskill",
            "task": self._task,
            "mani_skill": version("mani-skill"),
            "sapien": version("sapien"),
            "robot": env.agent.uid,
            "control_mode": env.control_mode,
            "obs_mode": env.obs_mode,
            "reward_mode": env.reward_mode,
            "sim_backend": env.backend.sim_backend,
            "render_backend": env.backend.render_backend,
            "render_device": None if (renderer := self.renderer()) is None else renderer.name,
            "shaders": {name: env.scene.sensors[name].config.shader_config.shader_pack for name in self.cameras},
            "num_envs": env.num_envs,
        }

    def alive(self) -> Any:
        """ManiSkill's environment; `EnvFailed` after `close`."""
        if self.env is None:
            raise EnvFailed(f"{self.name} is closed; make a new one")
        return self.env

    def close(self) -> None:
        """Free it; safe to call twice."""
        env, self.env, self._record = self.env, None, None
        if env is not None:
            env.close()

    def _check_usable(self) -> None:
        if not hasattr(self.env.agent, "robot"):  # it has no robot, or several
            raise ConfigError(f"{self.name}: want a task with exactly one robot")
        if "success" not in self.env.get_info():
            raise ConfigError(f"{self.name} does not say what success is: there is nothing to evaluate")

    def _choose(self, cameras: Sequence[str] | None) -> dict[str, CameraSpec]:
        seen = self.env.single_observation_space["sensor_data"]
        sizes = {name: textures["rgb"].shape[:2] for name, textures in seen.items() if "rgb" in textures.spaces}
        require_cameras(self.name, cameras or (), sizes)
        chosen = sizes if cameras is None else cameras
        return {name: CameraSpec(height=sizes[name][0], width=sizes[name][1]) for name in chosen}

    @contextlib.contextmanager
    def _observing(self, mode: str) -> Iterator[None]:
        """Have ManiSkill observe in another mode; what tasks add to the state, they decide by the own one."""
        env = self.alive()
        own, env._obs_mode = env._obs_mode, mode
        try:
            yield
        finally:
            env._obs_mode = own


class RecordCameras:
    """Cameras at the places of the task's cameras, created again with each scene."""

    def __init__(self, size: Size, names: Iterable[str]) -> None:
        self._height, self._width = size
        self._names = list(names)
        self._scene: Any = None
        self._cameras: dict[str, Any] = {}

    def views(self, env: Any) -> dict[str, np.ndarray]:
        """Return the current images of a single environment's cameras, (height, width, 3) uint8 RGB each."""
        if env.scene is not self._scene:
            self._cameras = {name: self._beside(env, name) for name in self._names}
            self._scene = env.scene
        env.scene.update_render(update_sensors=True, update_human_render_cameras=False)
        return {name: self._view(env, name) for name in self._names}

    def _beside(self, env: Any, name: str) -> Any:
        own = env._sensor_configs[name]
        intrinsic = None
        if own.intrinsic is not None:  # in pixels; a field of view needs no scaling
            scale = np.array([self._width / own.width, self._height / own.height, 1.0])
            intrinsic = np.asarray(own.intrinsic) * scale[:, np.newaxis]
        config = dataclasses.replace(
            own, uid=f"{name}_record", width=self._width, height=self._height, intrinsic=intrinsic
        )
        robot = env.agent.robot if name in env._agent_sensor_configs else None
        return require("mani_skill.sensors.camera").Camera(config, env.scene, articulation=robot)

    def _view(self, env: Any, name: str) -> np.ndarray:
        camera = self._cameras[name]
        camera.capture()
        overlay = (getattr(env, "_rgb_overlay_images", None) or {}).get(name)
        seen = camera.get_obs(depth=False, position=False, segmentation=overlay is not None)
        rgb = seen["rgb"]
        if overlay is not None:  # a digital twin, whose background is a photograph
            pil = require("PIL.Image")
            photograph = pil.fromarray(overlay.cpu().numpy().astype(np.uint8)).resize((self._width, self._height))
            background = require("torch").tensor(np.array(photograph), device=rgb.device)
            rgb = env._green_sceen_rgb(rgb, seen["segmentation"], background)
        return np.ascontiguousarray(rgb[0].cpu().numpy().astype(np.uint8))
