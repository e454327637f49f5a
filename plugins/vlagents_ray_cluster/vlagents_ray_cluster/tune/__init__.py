"""`vlagents-ray tune`: the best settings of a deployment file on this machine.

`tuner` measures variants of the file, each in its own process (`measured_policy`), and selects one.
The processes use a line protocol (`line_process`), which the programs in `benchmarks/` also use.
"""
