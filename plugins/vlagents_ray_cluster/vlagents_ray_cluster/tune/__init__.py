"""`vlagents-ray tune`: the best settings of a deployment file on this machine.

`tuner` measures variants of the file, each in its own process (`measured_policy`), and selects one.
Processes use a line protocol (`line_process`), as do those of the folder `benchmarks/` of the
checkout.
"""
