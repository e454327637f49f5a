"""The old place of `python -m vlagents_ray.serve.launch.haproxy`, kept for scripts that name it."""

import runpy
import sys

if __name__ == "__main__":
    sys.stderr.write("vlagents_ray.serve.haproxy has moved: write `python -m vlagents_ray.serve.launch.haproxy`\n")
    runpy.run_module("vlagents_ray.serve.launch.haproxy", run_name="__main__")
