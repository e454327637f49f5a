"""A control loop under the commands of people who watch it."""
