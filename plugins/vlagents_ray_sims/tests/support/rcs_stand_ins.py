"""Simple bodies in place of assets that tests do not have: those of RCS's two-arm scene, and all of
DuoBench's.

They have only the names and the sizes, in metres, on which DuoBench's `transfer_cube` depends.
Tests with them check how DuoBench's code is called, not how its objects behave.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
from pathlib import Path

_CAMERA = (
    '<mujoco><worldbody><body name="case"><camera name="lens" '
    'fovy="60"/></body></worldbody></mujoco>'
)

# Two bars that swing towards each other; RCS reads 0.005 rad as open and 1 rad as closed, and sends
# 0 and 255.
_FINGER = """
<body name="{side}_pad" pos="0 {y} 0.05">
  <joint name="{side}_driver_joint" type="hinge" axis="{axis} 0 0" range="0 1" damping="0.1"/>
  <geom type="box" size="0.01 0.004 0.05" pos="0 0 0.05" mass="0.02" friction="2 0.05 0.0001"/>
</body>"""
_GRIPPER = f"""
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="palm">
      <geom type="box" size="0.02 0.06 0.02" pos="0 0 0.02" mass="0.5"/>
      {_FINGER.format(side="left", y=0.05, axis=1)}
      {_FINGER.format(side="right", y=-0.05, axis=-1)}
    </body>
  </worldbody>
  <tendon>
    <fixed name="both">
      <joint joint="left_driver_joint" coef="0.5"/>
      <joint joint="right_driver_joint" coef="0.5"/>
    </fixed>
  </tendon>
  <equality><joint joint1="left_driver_joint" joint2="right_driver_joint"/></equality>
  <actuator>
    <general name="fingers_actuator" tendon="both" ctrlrange="0 255" gainprm="0.02" biastype="affine"
             biasprm="0 -5.1 -0.5"/>
  </actuator>
</mujoco>"""

_TABLE = """
<mujoco>
  <option integrator="implicitfast" impratio="20" noslip_iterations="5" cone="elliptic"/>
  <worldbody>
    <light pos="0 0 3" dir="0 0 -1" directional="true"/>
    <geom name="floor" type="plane" size="0 0 0.05"/>
    <geom name="table" type="box" size="1 1 0.02" pos="0.5 0 0.7895"/>
  </worldbody>
</mujoco>"""
_OBJECT = """
<mujoco>
  <worldbody>
    <body name="{name}_body">
      <freejoint name="{name}_joint"/>
      <geom name="{name}_visual_geom" type="{shape}" mass="0.05" rgba="1 1 1 1"/>
    </body>
  </worldbody>
</mujoco>"""

_RCS = {
    "grippers/robotiq_2f85/robotiq_2f85.xml": _GRIPPER,
    "cameras/d405/d405.xml": _CAMERA,
    "cameras/zed_mini/zed_mini.xml": _CAMERA,
}
_DUOBENCH = {
    "scenes/empty_world/scene.xml": _TABLE,  # the file with which RCS checks that there are assets
    "scenes/vention_table/vention_world.xml": _TABLE,
    "objects/transfer_gate/white_long_box.xml": _OBJECT.format(
        name="white_long_box", shape='box" size="0.015 0.015 0.02'
    ),
    "objects/bin_sort/white_bowl.xml": _OBJECT.format(
        name="white_bowl", shape='cylinder" size="0.06 0.004'
    ),
}


def write_rcs(source: Path, prefix: Path) -> None:
    """Copy the assets of one arm in `source`, and add the assets that the scene with two arms
    needs.
    """
    shutil.copytree(source, prefix, copy_function=shutil.copyfile)
    _write(_RCS, prefix)


def write_duobench(prefix: Path) -> None:
    """Write every file that `import duobench` checks for; all are empty except those of
    `transfer_cube`.
    """
    spec = importlib.util.find_spec("duobench")
    assert spec is not None
    assert spec.origin is not None
    wanted = re.findall(r'"assets/([^"]+\.xml)"', Path(spec.origin).read_text())
    _write(dict.fromkeys(wanted, "<mujoco/>") | _DUOBENCH, prefix)


def _write(files: dict[str, str], prefix: Path) -> None:
    for name, text in files.items():
        path = prefix / "assets" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.parent.chmod(0o755)  # the folder is a copy of a read-only folder
        if path.exists():
            path.chmod(0o644)
        path.write_text(text.strip())
