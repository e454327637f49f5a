"""Views for the record: a task's cameras once more, in another size."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np

from vlagents_ray.envs.recording import Size
from vlagents_ray.registry import require


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
