"""The versions of a served policy's weights, from the checkpoint that was loaded to the last one pushed."""
