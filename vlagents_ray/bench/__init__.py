"""Measurements that users can repeat on their own machines: `vlagents-ray bench …`."""
