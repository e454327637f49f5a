"""An evaluation in one file, for others to cite, to check, to play again in part, and to pool with their own."""

from vlagents_ray.evaluate.bundle.finding import Finding
from vlagents_ray.evaluate.bundle.verification import Verification, verify
from vlagents_ray.evaluate.bundle.writing import write_bundle

__all__ = ["Finding", "Verification", "verify", "write_bundle"]
