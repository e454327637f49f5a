"""Drawing on a machine: which GPU and which library draws, and what is missing."""
