"""Long work in processes of its own, so that Blender's interface never waits.

A job is a generator that a timer advances: it starts a process and looks at its files, reads results in a thread, and
hands them to Blender in pieces. Nothing here keeps anything of Blender's from one step to the next.
"""
