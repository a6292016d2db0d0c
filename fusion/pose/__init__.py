"""Where a new view was taken from."""
