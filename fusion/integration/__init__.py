"""From frames to a volume, all at once or live."""
