"""Open-loop evaluation: compare a policy's actions with the recorded actions of a dataset.

The policy receives the observations of the dataset, regardless of its own actions.
"""
