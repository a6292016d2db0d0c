import numpy as np
import pytest
import warp as wp
from dense_volume import closed_random_field, lattice, volume_of

from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh_pieces import MeshPieces, mesh_each, mesh_piece, weld

NAMES = ("vertices", "triangles", "colors", "normals")


def holed_volume(device, storage, *, seed=0, size=(37, 30, 28)):
    """Noise of both signs, colour and holes, over 5 × 4 × 4 blocks on both sides of the origin."""
    rng = np.random.default_rng(seed)
    return volume_of(
        np.clip(rng.normal(size=size), -1, 1),
        device,
        storage=storage,
        weight=(rng.random(size) < 0.95).astype(float),
        color=rng.integers(0, 256, (*size, 3)).astype(float),
        voxel_size=0.01,
        first_block=(-3, -1, 0),
    )


def assert_equal(mesh, expected):
    for name in NAMES:
        np.testing.assert_array_equal(getattr(mesh, name), getattr(expected, name))


def as_sets(mesh):
    """The triangles, each from its least corner on, as sorted rows: of their corners' positions, colours, normals."""
    corners = np.concatenate([mesh.vertices, mesh.colors.astype(np.float32), mesh.normals], axis=1)[mesh.triangles]
    turned = []
    for turn in range(3):
        turned.append(np.roll(corners, turn, axis=1).reshape(len(corners), -1))
    rows = np.stack(turned, 1)
    least = np.lexsort(np.moveaxis(rows, 2, 0)[::-1], axis=-1)[:, 0]
    return np.unique(rows[np.arange(len(rows)), least], axis=0)


@pytest.fixture(params=["packed", "full"])
def storage(request):
    return request.param


def test_all_blocks_at_once_are_the_whole_mesh(device, storage):
    volume = holed_volume(device, storage)
    assert_equal(
        marching_cubes(volume, blocks=range(volume.table.count), normals=True), marching_cubes(volume, normals=True)
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_welded_pieces_of_a_partition_are_the_whole_mesh(device, storage, seed):
    volume = holed_volume(device, storage)
    whole = marching_cubes(volume, normals=True)
    parts = np.random.default_rng(seed).integers(0, 2 + 3 * seed, volume.table.count)
    pieces = [mesh_piece(volume, np.flatnonzero(parts == part), normals=True) for part in np.unique(parts)]
    assert sum(len(piece.edges) for piece in pieces) > len(whole.vertices)
    welded = weld(pieces)
    # Vertices ascend by lattice edge whatever the partition; triangles come in the order of the pieces.
    np.testing.assert_array_equal(welded.vertices, whole.vertices)
    np.testing.assert_array_equal(welded.normals, whole.normals)
    np.testing.assert_array_equal(welded.colors, whole.colors)
    assert len(welded.triangles) == len(whole.triangles)
    np.testing.assert_array_equal(as_sets(welded), as_sets(whole))


def test_a_piece_is_complete_by_itself(device, storage):
    volume = holed_volume(device, storage)
    whole = marching_cubes(volume, normals=True)
    together = np.concatenate([mesh_piece(volume, [n], normals=True).edges for n in range(volume.table.count)])
    assert len(np.unique(together)) == len(whole.vertices)
    for number in (0, 17, 44):
        piece = mesh_piece(volume, [number], normals=True)
        np.testing.assert_array_equal(np.unique(piece.mesh.triangles), np.arange(len(piece.edges)))
        rows = {row.tobytes() for row in as_sets(whole)}
        assert {row.tobytes() for row in as_sets(piece.mesh)} <= rows


def test_each_blocks_piece_is_that_of_the_block_alone(device, storage):
    volume = holed_volume(device, storage)
    some = [3, 4, 5, 20, 60, 79]
    pieces = mesh_each(volume, some, normals=True)
    assert list(pieces) == [number for number in some if len(mesh_piece(volume, [number]).edges)]
    for number, piece in pieces.items():
        alone = mesh_piece(volume, [number], normals=True)
        assert_equal(weld([piece]), alone.mesh)
        np.testing.assert_array_equal(np.sort(piece.edges), alone.edges)


def test_vertices_that_meet_in_a_point_stay_apart(device):
    # A plane exactly through voxels: three edges end in each of them, and the mesh has a vertex on each.
    volume = volume_of(lattice(12).sum(-1) - 15, device)
    whole = marching_cubes(volume)
    assert len(np.unique(whole.vertices, axis=0)) < len(whole.vertices)
    assert_equal(weld(mesh_each(volume, range(volume.table.count)).values()), whole)


def test_no_pieces_give_an_empty_mesh():
    assert weld([]).triangles.shape == (0, 3)
    assert MeshPieces().mesh().vertices.shape == (0, 3)


@pytest.mark.parametrize("normals", [False, True])
def test_pieces_follow_a_volume_that_changes(device, storage, normals):
    volume = holed_volume(device, storage)
    pieces = MeshPieces(normals=normals)
    pieces.update(volume, range(volume.table.count))
    assert_equal(pieces.mesh(), marching_cubes(volume, normals=normals))
    rng = np.random.default_rng(7)
    for step in range(1, 6):
        changed = rng.choice(volume.table.count, 6, replace=False)
        source = holed_volume(device, storage, seed=step)
        for name, array in volume.arrays().items():
            values, other = array.numpy(), source.arrays()[name].numpy()
            for number in changed:
                # Now and then a block is emptied, as removing frames can do.
                values[512 * number : 512 * number + 512] = (
                    0 if rng.random() < 0.2 else other[512 * number : 512 * number + 512]
                )
            wp.copy(array, wp.array(values, dtype=array.dtype, device=device))
        stale = pieces.update(volume, changed)
        assert set(changed) <= set(stale)
        assert len(stale) < volume.table.count
        assert_equal(pieces.mesh(), marching_cubes(volume, normals=normals))


def test_pieces_follow_a_volume_that_grows(device, storage):
    whole = volume_of(closed_random_field(4, size=24), device, storage=storage)
    pieces = MeshPieces()
    blocks = whole.table.blocks.numpy()[: whole.table.count]
    for count in (5, 14, 27):
        volume = volume_of(np.zeros((8, 8, 8)), device, storage=storage)
        volume.table.__init__(device=device, max_blocks=100)
        volume.table.adopt(blocks[:count])
        volume.voxels = whole.voxels
        known = 0 if count == 5 else {14: 5, 27: 14}[count]
        pieces.update(volume, range(known, count))
        assert_equal(pieces.mesh(), marching_cubes(volume))
