"""Dataset formats: how each one is told from the others, read and written."""
