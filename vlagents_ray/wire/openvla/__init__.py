"""The bodies and the mappings of OpenVLA's REST protocol."""
