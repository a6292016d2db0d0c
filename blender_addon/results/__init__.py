"""Reconstructions in the scene: mesh, camera path, cameras, error colours, and the collection that holds them."""
