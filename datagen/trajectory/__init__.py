"""Where the camera is in every frame, computed without Blender."""
