"""The environment variables from which a server takes its API keys.

This module imports nothing, as the help of the commands names such a variable.
"""

FILE_VARIABLE, TEXT_VARIABLE = "VLAGENTS_RAY_KEYS_FILE", "VLAGENTS_RAY_KEYS"
