"""The batch queue: fair scheduling with deadlines and priorities, on the policy's thread."""
