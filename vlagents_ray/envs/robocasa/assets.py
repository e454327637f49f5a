"""RoboCasa's textures, appliances and objects, which lie in its package's folder, and which nothing here downloads."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

from vlagents_ray.errors import EnvFailed

REGISTRIES = ("objaverse", "lightwheel")  # of objects, those that RoboCasa draws from
TYPES = {"textures": "tex", "fixtures/stoves": "fixtures_lw"} | {
    "objects/objaverse": "objs_objaverse",
    "objects/lightwheel": "objs_lw",
}  # folder -> RoboCasa's name of the download that fills it


def require_assets(registries: Sequence[str] = REGISTRIES) -> None:
    """Raise `EnvFailed` if textures, appliances or the objects of one of `registries` are not there, with the cure."""
    spec = importlib.util.find_spec("robocasa")
    if spec is None or spec.origin is None:  # `require` says so better
        return
    folder = Path(spec.origin).parent / "models" / "assets"
    wanted = ["textures", "fixtures/stoves", *(f"objects/{name}" for name in registries)]
    lacks = [part for part in wanted if not (folder / part).is_dir()]
    if lacks:
        types = " ".join(TYPES[part] for part in lacks)
        raise EnvFailed(
            f"robocasa: the assets in {folder} lack {lacks}; download them once, about 10 GB, with that environment's "
            f"Python: python -m robocasa.scripts.download_kitchen_assets --type {types}; or make that folder a link to "
            f"a copy of them"
        )
