"""XPolicyLab's messages."""
