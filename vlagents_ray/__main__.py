"""Run the command `vlagents-ray` as `python -m vlagents_ray`, for shells whose PATH lacks the
console script.
"""

from vlagents_ray.cli import main

if __name__ == "__main__":
    main()
