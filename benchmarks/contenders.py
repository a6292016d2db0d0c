"""Integration alone: each contender takes decoded frames and gives two functions, one to fuse and one to mesh."""

import numpy as np

from datagen.rigid import inverse
from fusion.devices import load_kernels, resolve_device
from fusion.frames.frame_batch import MAX_BATCH, FrameUploader
from fusion.integration.fuse_batch import find_batch_blocks, integrate_batch, load_fusion_kernels
from fusion.integration.options import Integration
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.meshers import KERNEL_MODULES
from fusion.volume.tsdf_volume import Volume


def scanback(frames, camera, options):
    device = resolve_device(options.device)
    load_kernels(KERNEL_MODULES["marching-cubes"], device=device)
    load_fusion_kernels(Integration(), device=device)
    lengths = {"voxel_size": options.voxel_size, "truncation": options.truncation}

    # Depth as the images store it, which is also how Open3D takes it below.
    steps = np.stack([np.rint(f.depth / options.depth_scale).astype(np.uint16) for f in frames])
    poses = [f.world_from_camera for f in frames]
    colors = np.stack([f.color for f in frames])
    batches = [slice(first, first + MAX_BATCH) for first in range(0, len(frames), MAX_BATCH)]

    def integrate():
        volume = Volume(device=device, max_blocks=10**6, storage=options.storage, **lengths)
        upload = FrameUploader(camera, device=device, capacity=MAX_BATCH, depth_scale=options.depth_scale)
        tiles = [find_batch_blocks(volume.table, upload(steps[some], poses[some]), **lengths) for some in batches]
        volume.table.sort()
        volume.reserve(volume.table.count)
        for some, its_tiles in zip(batches, tiles, strict=True):
            integrate_batch(volume, upload(steps[some], poses[some], colors[some]), Integration(), tiles=its_tiles)
        return volume

    def extract(volume):
        mesh = marching_cubes(volume)
        return mesh.vertices, mesh.triangles

    return integrate, extract


def voxel_block_grid(frames, camera, options):
    import open3d as o3d
    import open3d.core as o3c

    intrinsics = o3c.Tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], o3c.float64)
    images = [
        (
            # It takes depth and colour both as integers or both as floats; the integers are its faster way.
            o3d.t.geometry.Image(o3c.Tensor(np.rint(f.depth / options.depth_scale).astype(np.uint16))),
            o3d.t.geometry.Image(o3c.Tensor(f.color)),
            o3c.Tensor(inverse(f.world_from_camera)),
        )
        for f in frames
    ]

    def integrate():
        grid = new_voxel_block_grid(options)
        for image in images:
            integrate_into_grid(grid, *image, intrinsics, options)
        return grid

    def extract(grid):
        mesh = grid.extract_triangle_mesh(weight_threshold=0.5)
        return mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()

    return integrate, extract


def new_voxel_block_grid(options):
    import open3d as o3d
    import open3d.core as o3c

    return o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(o3c.float32, o3c.uint16, o3c.uint16),
        attr_channels=((1), (1), (3)),
        voxel_size=options.voxel_size,
        block_resolution=16,
        block_count=10_000,
        device=o3c.Device("CPU:0"),
    )


def integrate_into_grid(grid, depth, color, extrinsics, intrinsics, options):
    lengths = {
        "depth_scale": 1 / options.depth_scale,
        "depth_max": options.depth_max,
        "trunc_voxel_multiplier": options.truncation / options.voxel_size,
    }
    blocks = grid.compute_unique_block_coordinates(depth, intrinsics, extrinsics, **lengths)
    grid.integrate(blocks, depth, color, intrinsics, intrinsics, extrinsics, **lengths)


def scalable_volume(frames, camera, options):
    import open3d as o3d

    intrinsics = o3d.camera.PinholeCameraIntrinsic(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    )
    images = [
        (
            o3d.geometry.RGBDImage.create_from_color_and_depth(
                o3d.geometry.Image(f.color),
                o3d.geometry.Image(f.depth),
                depth_scale=1.0,
                depth_trunc=options.depth_max,
                convert_rgb_to_intensity=False,
            ),
            inverse(f.world_from_camera),
        )
        for f in frames
    ]

    def integrate():
        volume = new_scalable_volume(options)
        for rgbd, extrinsics in images:
            volume.integrate(rgbd, intrinsics, extrinsics)
        return volume

    def extract(volume):
        mesh = volume.extract_triangle_mesh()
        return np.asarray(mesh.vertices), np.asarray(mesh.triangles)

    return integrate, extract


def new_scalable_volume(options):
    import open3d as o3d

    return o3d.pipelines.integration.ScalableTSDFVolume(
        voxel_length=options.voxel_size,
        sdf_trunc=options.truncation,
        color_type=o3d.pipelines.integration.TSDFVolumeColorType.RGB8,
    )


CONTENDERS = {
    "scanback": scanback,
    "Open3D VoxelBlockGrid": voxel_block_grid,
    "Open3D ScalableTSDFVolume": scalable_volume,
}
