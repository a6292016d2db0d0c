"""Closed surfaces in metres, made of numbers alone, without Blender."""
