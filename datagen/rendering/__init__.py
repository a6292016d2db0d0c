"""Rendering a scene into a dataset: processes, tasks, resuming. Blender itself is in ``datagen.blender``."""
