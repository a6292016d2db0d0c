"""Looking at a dataset: a contact sheet, a video, a GIF and a plot of the camera's path.

Needs the extra ``preview`` (matplotlib, Pillow, PyAV); nothing else of the package does.
"""
