"""Access control: API keys and their file, the check of origins, and the audit log."""
