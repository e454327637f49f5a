"""Open loop: the observations of a dataset are sent to a policy, whose actions are compared with
the recorded ones.
"""
