"""Parts of a server that show and record its sessions."""
