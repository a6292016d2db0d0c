"""The command line: a .blend file and pictures of a reconstruction, made without an interface.

The extension's zip leaves this package out: it needs what Blender does not bring along.
"""
