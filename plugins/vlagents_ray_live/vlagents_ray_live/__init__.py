"""Parts of a server that show and keep its sessions."""
