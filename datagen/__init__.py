"""Everything about data: cameras, the dataset format, scene files and rendering them in Blender.

Importing this package loads neither ``bpy`` nor ``warp``; Blender is touched only inside ``datagen.blender``.
"""
