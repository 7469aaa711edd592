"""The `ic` command."""
