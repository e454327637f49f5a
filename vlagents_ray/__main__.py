"""Run the command `vlagents-ray` as `python -m vlagents_ray`, where the console script is not on
the path.
"""

from vlagents_ray.cli import main

if __name__ == "__main__":
    main()
