"""Access control: API keys, their file, the check of origins, the audit log."""
