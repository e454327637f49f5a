"""The settings of a deployment file."""
