"""Arms, operators' devices and the check of a robot for the control loop of vlagents_ray."""

DISTRIBUTION = "vlagents-ray-robot"
