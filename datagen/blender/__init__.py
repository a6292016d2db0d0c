"""Rendering scenes in headless Blender; the only modules of the package that import ``bpy``, run in worker processes."""
