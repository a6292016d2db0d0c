"""Looking through the scan's camera: at the nearest frames of a place, one after the other, or all of them in time."""

# mypy: disable-error-code="valid-type,misc"
from typing import Any

import bpy
import numpy as np

from ..errors import ReconstructionError
from ..files.reconstruction_files import Record
from ..results.camera_conversion import set_render_size
from ..results.look_through import FRAME, RANKING, look_through, neighbour, point_is_visible, view_camera
from ..results.nearest_frames import frames_seeing
from ..results.replay_camera import add_replay
from .shown_collection import find_shown, record_of, shown_collection

TARGETS = (
    ("CURSOR", "3D Cursor", "The nearest frame that sees the 3D cursor"),
    ("SELECTION", "Selection", "The nearest frame that sees the middle of what is selected"),
    ("QUERY", "Query", "The frame that is nearest to the located query whose camera is selected"),
    ("FRAME", "Frame", "A frame by its number"),
)


class _ViewOperator:
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    match_render_size: bpy.props.BoolProperty(
        name="Match Render Size",
        description="Give renders the size and pixel aspect of the scan, so that the camera shows what the scan saw",
        default=True,
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        """Tell whether there is a reconstruction to look at."""
        if find_shown(context) is None:
            cls.poll_message_set("The scene has no reconstruction")  # type: ignore[attr-defined]
            return False
        return True

    def execute(self, context: Any) -> set[str]:
        """Do it, and report what cannot be done."""
        try:
            message = self.look(context)
            if self.match_render_size:
                set_render_size(context.scene.render, record_of(shown_collection(context)).intrinsics)
        except ReconstructionError as error:
            self.report({"ERROR"}, str(error))  # type: ignore[attr-defined]
            return {"CANCELLED"}
        _enter_camera_view(context)
        self.report({"INFO"}, message)  # type: ignore[attr-defined]
        return {"FINISHED"}

    def look(self, context: Any) -> str:
        """Place the camera and say where."""
        raise NotImplementedError


class SCANBACK_OT_look_through(_ViewOperator, bpy.types.Operator):  # noqa: N801
    """Looks through the nearest frame."""

    bl_idname = "scanback.look_through"
    bl_label = "Look Through Nearest"
    bl_description = "Look through the scan's camera where it was nearest, with the frame's picture behind"

    target: bpy.props.EnumProperty(name="Nearest To", description="What the frame is to be near to", items=TARGETS)
    frame: bpy.props.IntProperty(name="Frame", description="Number of the frame, for the target Frame", min=0)

    @classmethod
    def description(cls, context: Any, properties: Any) -> str:
        """Name the frame where that takes no search."""
        target = next(text for name, _, text in TARGETS if name == properties.target)
        active = context.view_layer.objects.active
        if properties.target == "QUERY" and active is not None and RANKING in active:
            target = f"Frame {active[RANKING][0]}, which is nearest to query {active.get('query', '?')}"
        return f"{target}, with its picture behind what is there"

    def look(self, context: Any) -> str:
        """Find the frame and place the camera."""
        collection = shown_collection(context)
        record = record_of(collection)
        ranking = self._ranking(context, collection, record)
        look_through(context.scene, collection, record, ranking[0], ranking)
        return f"Frame {ranking[0]}"

    def _ranking(self, context: Any, collection: bpy.types.Collection, record: Record) -> list[int]:
        if self.target == "FRAME":
            poses = {fused.frame: fused.world_from_camera for fused in record.trajectory}
            if self.frame not in poses:
                raise ReconstructionError(f"Frame {self.frame} is not one of those that were fused")
            point = poses[self.frame][:3, 3]
            near = sorted(poses, key=lambda frame: float(np.linalg.norm(poses[frame][:3, 3] - point)))
            return [self.frame, *(frame for frame in near if frame != self.frame)]
        if self.target == "QUERY":
            active = context.view_layer.objects.active
            if active is None or RANKING not in active:
                raise ReconstructionError("Select the camera of a located query first")
            return [int(frame) for frame in active[RANKING]]
        point = np.array(context.scene.cursor.location if self.target == "CURSOR" else _middle_of_selection(context))

        def is_visible(position: np.ndarray) -> bool:
            return point_is_visible(collection, point, position)

        return frames_seeing(point, record.trajectory, record.intrinsics, is_visible=is_visible)


class SCANBACK_OT_step_view(_ViewOperator, bpy.types.Operator):  # noqa: N801
    """Steps to the next nearest frame."""

    bl_idname = "scanback.step_view"
    bl_label = "Next Nearest"
    bl_description = "Look through the frame that is nearer or farther by one"

    step: bpy.props.IntProperty(name="Step", description="How many places farther in the order of nearness", default=1)

    @classmethod
    def description(cls, context: Any, properties: Any) -> str:
        """Name the frame that it leads to."""
        collection = find_shown(context)
        camera = view_camera(collection) if collection is not None else None
        if camera is None:
            return "Look through a frame first"
        frame = neighbour(camera, properties.step)
        if frame is None:
            return f"Frame {camera.get(FRAME, '?')} is the last in this direction"
        return (
            f"From frame {camera[FRAME]} to frame {frame}, the {'next' if properties.step > 0 else 'previous'} nearest"
        )

    def look(self, context: Any) -> str:
        """Step and place the camera."""
        collection = shown_collection(context)
        camera = view_camera(collection)
        if camera is None:
            raise ReconstructionError("Look through a frame first")
        frame = neighbour(camera, self.step)
        if frame is None:
            raise ReconstructionError(f"Frame {camera.get(FRAME, '?')} is the last in this direction")
        look_through(context.scene, collection, record_of(collection), frame, list(camera[RANKING]))
        return f"Frame {frame}"


class SCANBACK_OT_replay(_ViewOperator, bpy.types.Operator):  # noqa: N801
    """Adds a camera that goes the way of the scan again."""

    bl_idname = "scanback.replay"
    bl_label = "Replay the Scan"
    bl_description = "Add a camera with a key at each fused frame, that goes the way of the scan on the timeline"

    def look(self, context: Any) -> str:
        """Add the camera."""
        collection = shown_collection(context)
        record = record_of(collection)
        add_replay(context.scene, collection, record)
        return f"A camera replays {len(record.trajectory)} frames"


def _middle_of_selection(context: Any) -> np.ndarray:
    chosen = [item for item in context.view_layer.objects if item.select_get()]
    if not chosen:
        raise ReconstructionError("Nothing is selected; select what is to be seen")
    corners = [
        tuple(item.matrix_world @ type(item.location)(corner))
        for item in chosen
        for corner in (item.bound_box if item.type not in ("EMPTY", "CAMERA", "LIGHT") else [(0, 0, 0)])
    ]
    return (np.min(corners, axis=0) + np.max(corners, axis=0)) / 2


def _enter_camera_view(context: Any) -> None:
    space = context.space_data
    if space is not None and space.type == "VIEW_3D" and space.region_3d is not None:
        space.region_3d.view_perspective = "CAMERA"


CLASSES = (SCANBACK_OT_look_through, SCANBACK_OT_step_view, SCANBACK_OT_replay)
register, unregister = bpy.utils.register_classes_factory(CLASSES)
