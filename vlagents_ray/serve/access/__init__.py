"""Access control: API keys, their file, TLS, the check of origins, the audit log."""
