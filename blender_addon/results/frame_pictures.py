"""A scan's frame as the picture behind what its camera sees."""

from pathlib import Path

import bpy

from ..scan_folder import relative_path

ALPHA = 0.5


def show_behind(camera_data: bpy.types.Camera, picture: Path | None) -> None:
    """Show an image file behind what a camera sees, in the place and the way of what was shown; None shows nothing."""
    before = camera_data.background_images[0] if camera_data.background_images else None
    alpha, depth = (ALPHA, "BACK") if before is None else (before.alpha, before.display_depth)
    camera_data.background_images.clear()
    camera_data.show_background_images = picture is not None
    if picture is None:
        return
    background = camera_data.background_images.new()
    background.image = load_picture(picture)
    background.alpha = alpha
    background.display_depth = depth
    background.frame_method = "STRETCH"  # the picture spans the view exactly, whatever the pixels' aspect


def load_picture(picture: Path) -> bpy.types.Image:
    """Return an image of a file, one for all that show it, its path relative to a saved .blend."""
    return bpy.data.images.load(relative_path(picture), check_existing=True)
