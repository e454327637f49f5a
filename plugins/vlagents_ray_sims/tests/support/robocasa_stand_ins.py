"""A plain kitchen in place of RoboCasa's assets, about 10 GB that tests do not have.

RoboCasa's package has its scenes, its counters, cabinets and drawers; textures, appliances and
objects are a download. Here each texture has one colour, appliances are boxes without doors or
knobs, every object is a box, and all kitchens are the same. Tests with this kitchen check how
RoboCasa's code is called, seeded and read, not how its kitchens look or its objects behave.
"""

from __future__ import annotations

import ast
import importlib.util
import re
import shutil
import zlib
from pathlib import Path

import cv2
import numpy as np

_BOX = """
<mujoco>
  <asset/>
  <worldbody>
    <body>
      <body name="object">
        <geom name="body" type="box" pos="0 0 0" size="{half}" group="0"/>
        <geom name="look" type="box" pos="0 0 0" size="{half}" group="1" conaffinity="0" contype="0" rgba="{rgba} 1"/>
        <geom name="reg_{region}" type="box" pos="0 0 0" size="{half}" group="1" conaffinity="0" contype="0"
              rgba="0 0 0 0"/>
      </body>
      <site name="bottom_site" pos="0 0 -{height}"/>
      <site name="top_site" pos="0 0 {height}"/>
      <site name="horizontal_radius_site" pos="{height} 0 0"/>
    </body>
  </worldbody>
</mujoco>"""

_APPLIANCES = {"fridges/Refrigerator060": "0.2 0.4 0.8", "stoves/Stove001": "0.7 0.2 0.2"}
_KITCHEN = """
room:
  walls:
    - {name: wall, type: wall, size: [2.75, 1.5, 0.02], pos: [2.75, 0, 1.5]}
    - {name: wall_left, type: wall, wall_side: left, size: [1.5, 1.5, 0.02], pos: [0, -1.5, 1.5]}
    - {name: wall_right, type: wall, wall_side: right, size: [1.5, 1.5, 0.02], pos: [5.5, -1.5, 1.5]}
  floor:
    - {name: floor, type: floor, size: [2.75, 1.5, 0.02], pos: [2.75, -1.5, 0]}
main_group:
  bottom_row:
    - {name: counter_main, type: counter, size: [3.2, 0.65, 0.92], pos: [2.5, -0.325, 0.46]}
    - {name: stove, type: stove, align_to: counter_main, side: right, alignment: top_back}
    - {name: fridge, type: fridge_bottom_freezer, align_to: counter_main, side: left, alignment: bottom_back}
  top_row:
    - {name: cabinet, type: hinge_cabinet, size: [1, 0.4, 0.92], pos: [2.5, -0.2, 1.85]}
  drawers:
    - {name: drawers, type: stack, levels: [drawer, drawer], percentages: [0.7, 0.3], size: [0.6, 0.6, 0.84],
       pos: [2.5, -0.3, 0.47]}
"""
_STYLE = """
cabinet: {default: [gray, slab, handle_bar]}
counter: {default: default}
floor: default
wall: default
stove: Stove001
fridge_bottom_freezer: default
"""


def write_package(folder: Path) -> Path:
    """Write a copy of the installed robocasa with these assets into `folder`, for the first entry
    of `sys.path`.
    """
    spec = importlib.util.find_spec("robocasa")
    assert spec is not None
    assert spec.origin is not None
    installed, assets = Path(spec.origin).parent, folder / "kitchen"
    shutil.copytree(
        installed, folder / "robocasa", ignore=shutil.ignore_patterns("assets", "__pycache__")
    )
    shutil.copytree(installed / "models" / "assets", assets)
    (folder / "robocasa" / "models" / "assets").symlink_to(assets)
    for kind, text in (("layout", _KITCHEN), ("style", _STYLE)):
        for file in assets.glob(f"scenes/kitchen_{kind}s/*/{kind}*.yaml"):
            file.write_text(text)
    for name, rgba in _APPLIANCES.items():
        _write_box(assets / "fixtures" / name, "0.4 0.4 0.9", "main", rgba)
    for name in _folders(installed / "models" / "objects" / "kitchen_objects.py"):
        # Two objects, one for each split.
        for number, rgba in enumerate(("0.2 0.7 0.2", "0.7 0.7 0.2")):
            _write_box(
                assets / "objects" / name / f"plain_{number}", "0.03 0.03 0.02", "bbox", rgba
            )
    for file in [*assets.rglob("*.xml"), *assets.rglob("fixture_registry/*.yaml")]:
        for texture in re.findall(r"textures/[\w/]+\.png", file.read_text()):
            _write_texture(assets / texture)
    return folder


def _folders(categories: Path) -> set[str]:
    """Return the folders of all categories of objects, e.g. "objaverse/apple". RoboCasa's table of
    categories lists folders whose names differ from the category.
    """
    found = set()
    for category in ast.walk(ast.parse(categories.read_text())):
        for registry in getattr(getattr(category, "value", None), "keywords", []):
            if registry.arg in ("objaverse", "lightwheel"):
                own = [one.value for one in registry.value.keywords if one.arg == "model_folders"]
                found |= set(
                    ast.literal_eval(own[0]) if own else [f"{registry.arg}/{category.arg}"]
                )
    return found


def _write_box(folder: Path, half: str, region: str, rgba: str) -> None:
    folder.mkdir(parents=True)
    height = half.split()[2]
    (folder / "model.xml").write_text(
        _BOX.format(half=half, region=region, rgba=rgba, height=height)
    )


def _write_texture(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    colour = (
        100 + np.frombuffer(zlib.crc32(path.name.encode()).to_bytes(4, "big"), np.uint8)[:3] // 2
    )
    cv2.imwrite(str(path), np.full((8, 8, 3), colour, np.uint8))
