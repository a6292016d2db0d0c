"""Rendering scenes in headless Blender: the only modules that import ``bpy``, used in worker processes."""
