"""How the extension becomes zips: ``python -m blender_addon.packaging``, run in a checkout. It does not travel in them.

Wheels are downloaded for each platform and Python that Blender has, checked against each other and against the NumPy
that Blender brings, and handed to Blender's own extension tool, which builds and validates one zip a platform.
"""
