"""The block-sparse volume: its storage, files and operations."""
