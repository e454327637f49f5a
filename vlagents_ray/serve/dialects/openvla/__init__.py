"""OpenVLA's protocol: json_numpy over HTTP."""
