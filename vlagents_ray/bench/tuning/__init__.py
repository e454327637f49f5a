"""`vlagents-ray tune`: settings of a deployment file, measured on this machine.

`tuner` loads each variant of the settings in a process of its own (`process`), which measures it (`measured_policy`);
`parity` compares its actions with those of the file's own settings, and `choice` chooses.
"""
