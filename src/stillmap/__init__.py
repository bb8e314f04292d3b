"""Clean maps of what stands still."""
