"""Adding what a simulated sensor or a lens makes of its frames to a dataset that is there already."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from datagen.atomic_write import remove_unfinished
from datagen.dataset import COLOR_PART, DEPTH_PART, Dataset, Part
from datagen.dataset_format import Metadata, read_metadata, write_metadata
from datagen.errors import InputError
from datagen.layers import LAYERS, layer_file, write_layer
from datagen.open_dataset import open_dataset
from datagen.progress import ProgressReporter, silent
from datagen.rendering.folder_lock import claiming
from datagen.scene_spec.base import Spec
from datagen.scene_spec.lens_settings import LensSettings
from datagen.scene_spec.sensor_settings import SensorSettings
from datagen.sensors.extra_layers import distortion_of, lens_layers, sensor_depth


@dataclass(frozen=True, kw_only=True)
class Addition:
    """Layers to add: their names, what to read for them, how a frame's are made, and what records them.

    ``record`` is the key of ``dataset.json`` and its value; ``settings`` the key of a scene file and its value.
    """

    names: tuple[str, ...]
    parts: tuple[Part, ...]
    make: Callable[[int], dict[str, NDArray]]
    record: tuple[str, Any]
    settings: tuple[str, Spec]


def add_sensor_depth(dataset: Dataset, settings: SensorSettings, *, progress: ProgressReporter = silent) -> Dataset:
    """Add the layer ``sensor_depth`` to a dataset of ours, in place of one made with other settings, and return it.

    ``settings`` has its seed. The layer is listed in ``dataset.json`` when all of its images are there; a run that was
    killed goes on with those that are missing. Raises InputError for a dataset of another format, without all of its
    depth images or that another process works on, and where the layer cannot be written.
    """

    def make(frame: int) -> dict[str, NDArray]:
        depth, scale = dataset.depth(frame), dataset.depth_scale
        return {"sensor_depth": sensor_depth(depth, dataset.camera, settings, frame=frame, depth_scale=scale)}

    addition = Addition(
        names=("sensor_depth",),
        parts=(DEPTH_PART,),
        make=make,
        record=("sensor", settings),
        settings=("sensor", settings),
    )
    return _add(dataset, addition, progress)


def add_lens_layers(dataset: Dataset, lens: LensSettings, *, progress: ProgressReporter = silent) -> Dataset:
    """Add ``distorted_color`` and ``distorted_depth`` to a dataset of ours, in place of another lens', and return it.

    Resumed and refused as ``add_sensor_depth``. Depth comes from the stored images, so that it may differ by a step
    from what is made while rendering.
    """
    addition = Addition(
        names=("distorted_color", "distorted_depth"),
        parts=(COLOR_PART, DEPTH_PART),
        make=lambda frame: lens_layers(dataset.color(frame), dataset.depth(frame), dataset.camera, lens),
        record=("distortion", distortion_of(dataset.camera, lens)),
        settings=("lens", lens),
    )
    return _add(dataset, addition, progress)


def _add(dataset: Dataset, addition: Addition, progress: ProgressReporter) -> Dataset:
    folder = dataset.folder
    if dataset.metadata is None:
        raise InputError(
            f"{folder}: a {dataset.format_name} dataset has no place for layers; convert it first: "
            f"datagen convert {folder} OUT --format scanback"
        )
    dataset.require(dataset.frame_ids, parts=addition.parts)
    with claiming(folder, range(len(dataset.frame_ids))):
        metadata = read_metadata(folder)
        if getattr(metadata, addition.record[0]) != addition.record[1]:
            metadata = _begin_anew(dataset, metadata, addition)
        _write_missing(dataset, addition, progress)
        if not set(addition.names) <= set(metadata.layers):
            layers = tuple(dict.fromkeys((*metadata.layers, *addition.names)))
            write_metadata(folder, metadata.model_copy(update={"layers": layers}))
    return open_dataset(folder)


def _write_missing(dataset: Dataset, addition: Addition, progress: ProgressReporter) -> None:
    folder = dataset.folder
    for name in addition.names:
        remove_unfinished(folder / name)
    files = {i: [layer_file(folder, name, i) for name in addition.names] for i in dataset.frame_ids}
    missing = [i for i in dataset.frame_ids if not all(path.is_file() for path in files[i])]
    advance = progress(addition.settings[0].capitalize(), len(missing))
    for frame in missing:
        for name, image in addition.make(frame).items():
            write_layer(folder, name, frame, image, depth_scale=dataset.depth_scale)
        advance()


def _begin_anew(dataset: Dataset, metadata: Metadata, addition: Addition) -> Metadata:
    """Remove images of other settings and record the new ones; whenever this is cut short, a rerun begins it again."""
    (record, value), (key, settings) = addition.record, addition.settings
    others = tuple(name for name in metadata.layers if name not in addition.names)
    without = metadata.model_copy(update={"layers": others, record: None})
    write_metadata(dataset.folder, without)
    for name in addition.names:
        for image in (dataset.folder / name).glob(f"frame-*.{LAYERS[name].part}"):
            image.unlink()
    recipe = without.recipe
    if recipe.get(key) is not None:  # it would tell of images that are gone
        recipe = recipe | {key: settings.model_dump(mode="json")}
    begun = without.model_copy(update={record: value, "recipe": recipe})
    write_metadata(dataset.folder, begun)
    return begun
