"""What the recordings determine, and how well."""
