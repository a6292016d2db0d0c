"""The commands of ``fusion``, one module each: its options, one call, what it prints."""
