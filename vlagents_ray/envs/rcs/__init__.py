"""RCS, the Robot Control Stack, in MuJoCo, and DuoBench, the benchmark for two arms that is built on it.

Both need packages that contradict the simulators of this package's extras, and RCS is AGPL-3: they
need a separate Python environment, requirements/rcs.txt. See docs/benchmarks/rcs.md.
"""

from vlagents_ray.envs.rcs.env import DuoBench, Rcs

__all__ = ["DuoBench", "Rcs"]
