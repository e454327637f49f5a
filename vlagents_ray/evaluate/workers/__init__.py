"""The workers that run episodes, in Ray actors or in this process."""
