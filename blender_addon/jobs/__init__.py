"""Long work in processes of its own, so that Blender's interface never waits."""
