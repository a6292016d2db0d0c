"""Figures 8 and 12: the coloured mesh beside the photograph, and how far it is from what the camera saw."""

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.report.panels import Figure, Numbers, Panel, Picture, clay_picture, error_picture, errors, percent
from fusion.report.runs import Run
from fusion.report.subject import Subject
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh


def coloured(subject: Subject) -> Figure:
    """Show the mesh of all frames in its own colours, from where one of them was taken."""
    result = subject.reconstruct()
    subject.advance()
    frame = subject.view.frame
    photograph = photograph_in_view(subject)
    assert result.mesh.colors is not None
    image = subject.picture(result.mesh, result.mesh.colors / 255, shaded=False)
    numbers = (*_colour_numbers(subject, result, photograph, image), *_speed(result))
    panels = [
        Panel(
            title="what the camera saw",
            pictures=(Picture(name="photograph", image=photograph, numbers=(("frame", f"{frame}"),)),),
        ),
        Panel(title="the mesh in its colours", pictures=(Picture(name="coloured", image=image, numbers=numbers),)),
        Panel(
            title="its shape",
            pictures=(clay_picture(subject, result, "shape", extra=_depth_numbers(subject, result)),),
        ),
    ]
    if result.record.metrics is not None:
        beneath = errors(result.record.metrics)
        error = error_picture(subject, result.mesh, "coloured", most=subject.voxel_size / 2, numbers=beneath)
        panels.append(Panel(title="its distance from the truth", pictures=error))
    number, what = ("8", "the coloured mesh") if subject.truth is not None else ("12", "a real scene")
    return Figure(
        heading=f"Fig. {number}: {what}",
        text=f"All {len(subject.dataset.frame_ids)} frames, fused. A vertex has the weighted mean of the colours that "
        "the frames saw there. Colour is compared with the photograph and depth with the frame's own, pixel by pixel.",
        panels=tuple(panels),
        columns=len(panels),
    )


def photograph_in_view(subject: Subject) -> NDArray[np.uint8]:
    """Return the colour image of the view's frame as the view's camera would have taken it: (height, width, 3)."""
    camera, seen = subject.view.camera, subject.dataset.camera
    image: cv2.typing.MatLike = subject.dataset.color(subject.view.frame)
    scale_x, scale_y = seen.fx / camera.fx, seen.fy / camera.fy
    image_from_view = np.array(
        [[scale_x, 0, seen.cx - scale_x * camera.cx], [0, scale_y, seen.cy - scale_y * camera.cy]]
    )
    size = camera.width, camera.height
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    if max(scale_x, scale_y) > 1:  # not every pixel would be asked
        image = cv2.GaussianBlur(image, (0, 0), 0.5 * scale_x)
    return cv2.warpAffine(image, image_from_view, size, flags=flags, borderMode=cv2.BORDER_REPLICATE).astype(np.uint8)


def _colour_numbers(subject: Subject, result: Run, photograph: NDArray[np.uint8], image: NDArray[np.uint8]) -> Numbers:
    """Return the peak signal-to-noise ratio of the mesh's colours to the photograph's, where there is mesh."""
    view = subject.view
    hits = cast_rays_at_mesh(result.mesh, view.camera, [view.world_from_camera], device=subject.device, depth_only=True)
    # Pixels at an outline are partly background.
    hit = cv2.erode((hits.depth.numpy()[0] > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    if not hit.any():
        return ()
    squared = np.mean((photograph[hit].astype(np.float64) - image[hit]) ** 2)
    return (("colour, PSNR", f"{10 * np.log10(255**2 / max(squared, 1e-9)):.1f} dB"),)


def _speed(result: Run) -> Numbers:
    return (("fusion", f"{result.record.frames_per_second:,.0f} frames/s"),)


def _depth_numbers(subject: Subject, result: Run) -> Numbers:
    """Return how far the mesh is from the depth that the frame has, and of how much of it there is mesh."""
    dataset, view = subject.dataset, subject.view
    ours = cast_rays_at_mesh(
        result.mesh, dataset.camera, [view.world_from_camera], device=subject.device, depth_only=True
    ).depth.numpy()[0]
    theirs = dataset.depth(view.frame)
    if subject.base.depth_max is not None:
        theirs[theirs > subject.base.depth_max] = 0
    both = (ours > 0) & (theirs > 0)
    if not both.any():
        return ()
    apart = float(np.median(np.abs(ours[both] - theirs[both])))
    return ("depth off by", f"{1000 * apart:.2g} mm"), ("pixels covered", percent(both.sum() / (theirs > 0).sum()))
