"""The whole way: each contender reads the images of a folder, fuses them and writes the mesh as PLY.

Ours is what ``fusion reconstruct`` runs, so it also writes the volume and the record. Open3D's are the loops of its
documentation, each with the image reader of its own interface.
"""

from pathlib import Path

from benchmarks.contenders import integrate_into_grid, new_scalable_volume, new_voxel_block_grid
from datagen.frame_selection import select_frames
from datagen.rigid import inverse
from fusion.devices import load_kernels, resolve_device
from fusion.integration.fuse_batch import load_fusion_kernels
from fusion.integration.options import Integration
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import EXACT, ReconstructionConfig
from fusion.surface.meshers import KERNEL_MODULES


def scanback(dataset, options):
    config = ReconstructionConfig(
        voxel_size=options.voxel_size,
        truncation=options.truncation,
        depth_max=options.depth_max,
        frames=options.frames,
        device=options.device,
        storage=options.storage,
        # Open3D takes the nearest pixel too; the defaults of fusion reconstruct do more.
        integration=EXACT if options.exact else Integration(),
    )
    device = resolve_device(options.device)
    load_kernels(KERNEL_MODULES[config.mesher], device=device)
    load_fusion_kernels(config.integration, device=device)

    def run():
        record = reconstruct(dataset, Path(options.mesh).parent, config).record
        return dict(record.seconds)

    return run


def voxel_block_grid(dataset, options):
    import open3d as o3d
    import open3d.core as o3c

    camera = dataset.camera
    intrinsics = o3c.Tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], o3c.float64)

    def run():
        grid = new_voxel_block_grid(options)
        for depth_file, color_file, pose in frame_files(dataset, options):
            depth, color = o3d.t.io.read_image(depth_file), o3d.t.io.read_image(color_file)
            integrate_into_grid(grid, depth, color, o3c.Tensor(inverse(pose)), intrinsics, options)
        mesh = grid.extract_triangle_mesh(weight_threshold=0.5)
        o3d.t.io.write_triangle_mesh(options.mesh, mesh)

    return run


def scalable_volume(dataset, options):
    import open3d as o3d

    camera = dataset.camera
    intrinsics = o3d.camera.PinholeCameraIntrinsic(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    )

    def run():
        volume = new_scalable_volume(options)
        for depth_file, color_file, pose in frame_files(dataset, options):
            rgbd = o3d.geometry.RGBDImage.create_from_color_and_depth(
                o3d.io.read_image(color_file),
                o3d.io.read_image(depth_file),
                depth_scale=1 / options.depth_scale,
                depth_trunc=options.depth_max,
                convert_rgb_to_intensity=False,
            )
            volume.integrate(rgbd, intrinsics, inverse(pose))
        o3d.io.write_triangle_mesh(options.mesh, volume.extract_triangle_mesh())

    return run


def frame_files(dataset, options):
    for frame_id in select_frames(dataset.frame_ids, options.frames):
        pose = dataset.world_from_camera(frame_id)
        yield str(dataset.depth_file(frame_id)), str(dataset.color_file(frame_id)), pose


CONTENDERS = {
    "scanback": scanback,
    "Open3D VoxelBlockGrid": voxel_block_grid,
    "Open3D ScalableTSDFVolume": scalable_volume,
}
