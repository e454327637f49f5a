"""All that needs a GPU, measured and checked by one command: `python -m benchmarks.gpu`."""
