"""The batch queue: fair scheduling with deadlines and request classes, on the policy's thread."""
