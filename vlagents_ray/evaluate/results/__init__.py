"""The folder of results: written exactly once, read, merged, compared, summarised."""
