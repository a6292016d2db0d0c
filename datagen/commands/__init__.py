"""The commands of ``datagen``, one module each: its options, one call, what it prints."""
