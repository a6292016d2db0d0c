"""Is a dataset what it says it is? Faults found by reprojection, named, with their evidence. Needs no Blender."""
