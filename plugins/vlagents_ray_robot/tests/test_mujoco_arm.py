"""Tests of arms in MuJoCo: names, files, units, and a stop."""

import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from arm_models import ARMS, model_file, simulated_arm

from vlagents_ray.errors import ConfigError, InvalidAction
from vlagents_ray.robot.loop import robot_factory
from vlagents_ray.validation import check_observation
from vlagents_ray_robot.mujoco_arm import MujocoArm, SimulatedClock

pytestmark = pytest.mark.sim
MOTOR = """<mujoco><worldbody><body><joint name="a" range="-1 1"/><geom size="0.1"/></body></worldbody>
<actuator>{}</actuator></mujoco>"""


@pytest.mark.parametrize("name", ARMS)
def test_an_arm_gives_what_its_contract_states_and_goes_where_it_is_sent(name: str) -> None:
    with closing(simulated_arm(name, cameras=())) as arm:
        obs = arm.observe()
        check_observation(obs, arm.contract)
        assert arm.contract.action.dim == len(arm.joint_names) + (obs.gripper is not None) * len(
            arm.arms
        )
        assert (arm.joint_limits[:, 0] < arm.joints()).all()
        assert (arm.joints() < arm.joint_limits[:, 1]).all()
        action = np.array(arm._goal, np.float32)
        action[0] += 0.2
        arm.apply(action)
        arm.clock.sleep(0.02)
        assert np.allclose(arm.joints()[0], obs.state[next(iter(obs.state))][0], atol=2e-3), (
            "before the latency"
        )
        arm.clock.sleep(2.0)
        assert arm.joints()[0] == pytest.approx(action[0], abs=0.02)


def test_a_stop_ends_a_motion_and_forgets_commands() -> None:
    with closing(simulated_arm("franka", cameras=())) as arm:
        start = arm.joints()
        action = np.array(arm._goal)
        action[0] += 1.0
        arm.apply(action)
        arm.clock.sleep(0.2)
        arm.stop()
        stopped = arm.joints()
        arm.clock.sleep(1.0)
        assert 0.05 < stopped[0] - start[0] < 0.3
        assert np.abs(arm.joints() - stopped).max() < 0.02
        with pytest.raises(InvalidAction, match=r"expected shape \(8,\), got \(7,\)"):
            arm.apply(np.zeros(7))


def test_a_name_gives_an_arm_with_its_settings() -> None:
    make = robot_factory(
        "--robot", f"mujoco:{model_file('ur5e')}", ["like=ur5e", "cameras=[]", "speed=0.5"]
    )
    arm = make(clock=SimulatedClock())
    assert isinstance(arm, MujocoArm)
    assert arm.speed == 0.5
    assert arm.contract.cameras == {}


def test_a_joint_without_limits_has_those_of_two_turns(tmp_path: Path) -> None:
    file = tmp_path / "arm.xml"
    file.write_text(MOTOR.format('<position joint="a" kp="10"/>').replace(' range="-1 1"', ""))
    assert MujocoArm(file, cameras=(), clock=SimulatedClock()).joint_limits == pytest.approx(
        np.array([[-2 * np.pi, 2 * np.pi]])
    )


def test_a_wrong_model_is_an_error_with_its_cure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match="which does not exist"):
        MujocoArm("missing.xml")
    torque = tmp_path / "torque.xml"
    torque.write_text(MOTOR.format('<motor joint="a"/>'))
    with pytest.raises(ConfigError, match="expected a position controller"):
        MujocoArm(torque)
    with pytest.raises(ConfigError, match="did you mean 'so101'"):
        MujocoArm("so1o1")
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    with pytest.raises(ConfigError, match="set MENAGERIE_ROOT to a folder"):
        MujocoArm("so101")


def test_the_module_chooses_the_renderer_before_a_package_of_models_imports_mujoco() -> None:
    script = "import os, vlagents_ray_robot.mujoco_arm; print(os.environ['MUJOCO_GL'])"
    environment = {"PYTHONPATH": os.pathsep.join(sys.path)}  # there is no display
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout == "egl\n"
