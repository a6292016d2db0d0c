"""Depth, normals, masks, flow and intrinsics against ray casting in double precision."""

import numpy as np
import pytest
from exact_raster import cast

from datagen.camera import PinholeCamera
from datagen.color import linear_from_srgb
from datagen.dataset import read_pose
from datagen.dataset_format import FRAMES_FOLDER, frame_file
from datagen.images import read_color, read_depth
from datagen.layers import LAYERS, layer_file
from datagen.rigid import inverse, transform_points
from datagen.scene_spec.camera_settings import CameraSettings

SIZE = (160, 120)
SUZANNE = {"name": "S", "shape": "suzanne", "material": "red", "scale": 0.4, "subdivision": 1, "smooth": True}
FLOOR = {"name": "F", "shape": "plane", "material": "red", "scale": 3, "location": [0, 0, -0.4]}
# A sheet a millimetre thick, two metres wide: its sides are triangles 2 m long and 1 mm high, seen from close by.
SHEET = {"name": "T", "shape": "cube", "material": "red", "scale": [1, 0.3, 0.0005], "rotation_deg": [25, 4, 20]}
CLOSE = [
    {"time": 0, "position": [-0.3, -0.45, 0.0], "look_at": [0, -0.25, -0.1]},
    {"time": 1, "position": [-0.2, -0.45, 0.02], "look_at": [0, -0.25, -0.1]},
]


def render_settings(**more):
    return {"frames": 3, "size": list(SIZE), "samples": 4, "denoise": False} | more


def write(session, folder, frame=1):
    """Write a frame and return its files' contents: colour, depth, pose, and a reader of its layers."""
    session.write_frame(folder, frame)
    frames = folder / FRAMES_FOLDER
    scale = session.spec.render.depth_scale
    depth = read_depth(frame_file(frames, frame, "depth.png"), size=SIZE, metres_per_step=scale)
    return (
        depth,
        read_pose(frame_file(frames, frame, "pose.txt")),
        lambda name: LAYERS[name].decode(layer_file(folder, name, frame)),
    )


def exact_depth(session, frame=1):
    """Return a frame's depth before it is quantised, and its pose."""
    from datagen.blender import shot

    taken = session.render(frame)
    rendered = shot._read_exact(
        taken.image, taken.world_from_camera, session.spec, session.camera, session._thin_triangles
    )
    return rendered.depth, taken.world_from_camera


def truth(session, camera, world_from_camera):
    from datagen.blender.ground_truth import evaluated_mesh

    mesh = evaluated_mesh()
    return cast(mesh.vertices_world, mesh.triangles, camera, world_from_camera)


def moved(camera, du, dv):
    values = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return PinholeCamera(**(values | {"cx": camera.cx + du, "cy": camera.cy + dv}))


def require_exact(session, depth, pose):
    """Assert that depth is the truth's; where a ray grazes an edge, that of a ray a thousandth of a pixel beside it."""
    exact = truth(session, session.camera, pose).depth
    with np.errstate(invalid="ignore"):
        error = np.where(np.isinf(exact), np.where(depth == 0, 0, np.inf), depth / exact - 1)
    odd = np.abs(error) > 1e-4
    assert odd.sum() <= 3
    if odd.any():
        beside = [
            truth(session, moved(session.camera, du, dv), pose).depth[odd]
            for du in (-1e-3, 1e-3)
            for dv in (-1e-3, 1e-3)
        ]
        there = np.where(depth[odd] == 0, np.inf, depth[odd])
        assert any(np.allclose(there, other, rtol=1e-3) for other in beside)
    assert np.sqrt(np.mean(error[~odd] ** 2)) <= 1e-6
    return exact, odd


@pytest.mark.parametrize(
    "content",
    [{"objects": [SUZANNE, FLOOR]}, {"objects": [SHEET]}, {"objects": [SHEET], "keyframes": CLOSE}],
    ids=["suzanne on a floor", "thin sheet", "thin sheet from close by"],
)
def test_depth_is_that_of_ray_casting_the_mesh_at_pixel_centres(open_session, make_scene, content):
    session = open_session(make_scene(render=render_settings(), **content))
    depth, pose = exact_depth(session)
    assert (depth > 0).mean() > 0.02
    require_exact(session, depth, pose)


def test_without_the_correction_thin_triangles_would_be_seen_where_they_are_not(open_session, make_scene):
    session = open_session(make_scene(render=render_settings(), objects=[SHEET], keyframes=CLOSE))
    assert len(session._thin_triangles) == 8
    session._thin_triangles = session._thin_triangles[:0]
    depth, pose = exact_depth(session)
    exact = truth(session, session.camera, pose).depth
    both = (depth > 0) & np.isfinite(exact)
    assert np.sqrt(np.mean((depth[both] / exact[both] - 1) ** 2)) > 1e-6


def test_depth_on_disk_is_within_half_a_step_of_ray_casting(open_session, make_scene, tmp_path):
    session = open_session(make_scene(render=render_settings(), objects=[SUZANNE, FLOOR]))
    depth, pose, _ = write(session, tmp_path)
    exact = truth(session, session.camera, pose).depth
    seen = np.isfinite(exact)
    steps = np.abs(depth.astype(np.float64) - exact)[seen] / 1e-4
    assert np.sort(steps)[-4] <= 0.5 * 1.03  # of 10,000 pixels three may graze an edge; depth is exact to 1e-6 m itself


CAMERAS = {
    "vertical fit": {"sensor_fit": "vertical", "focal_length_mm": 20.0, "sensor_height_mm": 18.0},
    "automatic fit": {"sensor_fit": "auto", "focal_length_mm": 30.0},
    "field of view": {"field_of_view_deg": 70.0},
    "shift": {"shift_x": 0.11, "shift_y": -0.07},
    "wide pixels": {"pixel_aspect": 1.6, "shift_x": -0.05, "shift_y": 0.08},
    "high pixels": {"pixel_aspect": 0.7, "sensor_fit": "vertical", "shift_x": 0.05, "shift_y": 0.08},
    "matrix": {"intrinsics_px": [190.0, 171.5, 70.25, 66.75]},
}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_every_way_to_say_the_intrinsics_renders_them(open_session, make_scene, camera, tmp_path):
    session = open_session(make_scene(render=render_settings(), objects=[SUZANNE, FLOOR], camera=camera))
    depth, pose = exact_depth(session)
    require_exact(session, depth, pose)


@pytest.mark.parametrize("camera", [value for name, value in CAMERAS.items() if name != "matrix"])
@pytest.mark.parametrize("size", [(160, 120), (90, 120)])
def test_the_lens_law_is_blenders_own(open_session, make_scene, camera, size):
    """Blender's camera with the same settings, put in by Blender's names, projects as the declared one."""
    from datagen.blender.camera import read_intrinsics

    session = open_session(make_scene(render=render_settings(size=list(size)), camera=camera))
    settings = CameraSettings(**camera)
    data, render = session.scene.camera.data, session.scene.render
    data.pop("first_sample_px")
    data.sensor_fit = settings.sensor_fit.upper()
    data.sensor_width, data.sensor_height = settings.sensor_width_mm, settings.sensor_height_mm
    data.shift_x, data.shift_y = settings.shift_x, settings.shift_y
    render.pixel_aspect_x = max(1.0, settings.pixel_aspect)
    render.pixel_aspect_y = max(1.0, 1 / settings.pixel_aspect)
    if settings.field_of_view_deg is not None:
        data.angle = np.radians(settings.field_of_view_deg)
    else:
        data.lens = settings.focal_length_mm
    found, declared = read_intrinsics(session.scene), settings.pinhole(size)
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(found, name) == pytest.approx(getattr(declared, name), abs=1e-3), name


def test_a_balls_centroid_is_where_shift_fit_and_pixel_aspect_put_it_in_colour_and_in_depth(
    open_session, make_scene, tmp_path
):
    camera = {"sensor_fit": "vertical", "shift_x": 0.1, "shift_y": -0.05, "pixel_aspect": 1.25}
    ball = {"name": "B", "shape": "sphere", "material": "black", "scale": 0.2}
    session = open_session(
        make_scene(
            render=render_settings(samples=64),
            objects=[ball],
            camera=camera,
            materials={"black": {"color": "#000000", "roughness": 1.0}},
            lights=[],
            world={"color": "#ffffff", "strength": 1.0},
        )
    )
    from datagen.blender.ground_truth import evaluated_mesh

    depth, pose, _ = write(session, tmp_path, 0)
    mesh = evaluated_mesh()
    fine = PinholeCamera(
        width=SIZE[0] * 4,
        height=SIZE[1] * 4,
        fx=session.camera.fx * 4,
        fy=session.camera.fy * 4,
        cx=session.camera.cx * 4 + 1.5,
        cy=session.camera.cy * 4 + 1.5,
    )
    silhouette = np.isfinite(cast(mesh.vertices_world, mesh.triangles, fine, pose).depth)
    expected = (centroid(silhouette) - 1.5) / 4
    color = read_color(frame_file(tmp_path / FRAMES_FOLDER, 0, "color.png"), size=SIZE)
    covered = 1 - linear_from_srgb(color.mean(axis=-1) / 255)
    np.testing.assert_allclose(centroid(covered), expected, atol=0.02)
    exact = truth(session, session.camera, pose).depth
    np.testing.assert_allclose(centroid(depth > 0), centroid(np.isfinite(exact)), atol=1e-3)


def centroid(weights):
    v, u = np.indices(weights.shape)
    return np.array([(u * weights).sum(), (v * weights).sum()]) / weights.sum()


def test_normals_are_those_of_the_geometry_at_pixel_centres_whatever_the_samples(open_session, make_scene, tmp_path):
    settings = render_settings(layers=["normals"])
    session = open_session(make_scene(render=settings, objects=[SUZANNE, FLOOR]))
    depth, pose, layer = write(session, tmp_path)
    normals, exact = layer("normals"), truth(session, session.camera, pose)
    assert ((normals == 0).all(axis=-1) == (depth == 0)).all()
    np.testing.assert_allclose(np.linalg.norm(normals[depth > 0], axis=-1), 1, atol=1e-4)  # 16 bits
    seen = (depth > 0) & np.isfinite(exact.depth)
    off = np.linalg.norm(normals - exact.normals, axis=-1)[seen]
    assert np.mean(off > 1e-4) < 1e-3  # rays that pass on the other side of an edge between two triangles
    rays = session.camera.back_project(np.ones_like(depth))
    assert ((normals * rays).sum(axis=-1) <= 1e-3).all()


def test_masks_name_the_object_at_the_pixel_centre(open_session, make_scene, tmp_path):
    two = [SUZANNE, {"name": "B", "shape": "sphere", "material": "red", "scale": 0.2, "location": [0.5, -0.4, 0]}]
    session = open_session(make_scene(render=render_settings(layers=["masks"], samples=8), objects=two))
    from datagen.blender.ground_truth import evaluated_mesh

    depth, pose, layer = write(session, tmp_path)
    mesh = evaluated_mesh()
    hit = cast(mesh.vertices_world, mesh.triangles, session.camera, pose).triangle
    points = transform_points(pose, session.camera.back_project(depth))
    on_ball = np.abs(np.linalg.norm(points - [0.5, -0.4, 0], axis=-1) - 0.2) < 2e-3
    masks = layer("masks")
    assert masks.dtype == np.uint16
    assert set(np.unique(masks)) == {0, 1, 2}
    assert ((masks > 0) == (hit >= 0)).all()
    assert np.mean((masks == 2) != (on_ball & (depth > 0))) < 1e-3


def test_flow_leads_to_where_the_next_frame_shows_the_same_point(open_session, make_scene, tmp_path):
    session = open_session(make_scene(render=render_settings(layers=["flow"]), objects=[SUZANNE, FLOOR]))
    depth, pose, layer = write(session, tmp_path, 1)
    _, next_pose, next_layer = write(session, tmp_path, 2)
    flow = layer("flow")
    assert (np.isnan(flow).any(axis=-1) == (depth == 0)).all()
    exact = truth(session, session.camera, pose).depth
    seen = np.isfinite(exact)
    points = transform_points(pose, session.camera.back_project(np.where(seen, exact, 0)))
    wanted = session.camera.project(transform_points(inverse(next_pose), points))
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    error = np.abs(flow - (wanted - np.stack([u, v], axis=-1)))[seen & (depth > 0)]
    assert np.nanquantile(error, 0.999) < 1e-3
    assert np.nanmax(np.abs(flow)) > 3
    assert np.isnan(next_layer("flow")).all()  # nothing follows the last frame


def test_objects_that_move_are_noticed_because_flow_and_the_true_mesh_know_nothing_of_them(open_session, make_scene):
    session = open_session(make_scene(render=render_settings(), objects=[SUZANNE]))
    session.scene.objects["S"].keyframe_insert("location", frame=0)
    session.scene.objects["S"].location.x += 1
    session.scene.objects["S"].keyframe_insert("location", frame=2)
    assert session._moving_objects() == ["S"]


def test_the_right_camera_stands_a_baseline_to_the_right_and_sees_the_same_scene(open_session, make_scene, tmp_path):
    session = open_session(
        make_scene(render=render_settings(), objects=[SUZANNE, FLOOR], camera={"stereo_baseline": 0.06})
    )
    depth, pose, _ = write(session, tmp_path)
    right_pose = pose.copy()
    right_pose[:3, 3] += 0.06 * pose[:3, 0]
    right = read_depth(layer_file(tmp_path, "right_depth", 1), size=SIZE, metres_per_step=1e-4)
    exact = truth(session, session.camera, right_pose).depth
    seen = np.isfinite(exact)
    assert np.sort(np.abs(right - exact)[seen])[-4] <= 0.6e-4
    assert np.abs(depth - right).max() > 0.05
    color = read_color(layer_file(tmp_path, "right_color", 1), size=SIZE)
    left = read_color(frame_file(tmp_path / FRAMES_FOLDER, 1, "color.png"), size=SIZE)
    assert (color != left).any()
