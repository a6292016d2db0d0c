"""Boxes of cells that one vertex serves, where the surface is flat."""
