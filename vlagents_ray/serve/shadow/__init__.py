"""A candidate beside the policy: it acts on live observations, and its actions are compared, never executed."""
