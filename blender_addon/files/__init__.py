"""What the pipeline wrote, read without anything but numpy: reconstructions, datasets, meshes."""
