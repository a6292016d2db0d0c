"""Adding a simulated sensor's depth to a dataset that is there already."""

from datagen.atomic_write import remove_unfinished
from datagen.dataset import DEPTH_PART, Dataset
from datagen.dataset_format import Metadata, read_metadata, write_metadata
from datagen.errors import InputError
from datagen.layers import LAYERS, layer_file, write_layer
from datagen.open_dataset import open_dataset
from datagen.progress import ProgressReporter, silent
from datagen.rendering.folder_lock import claiming
from datagen.scene_spec.sensor_settings import SensorSettings
from datagen.sensors.extra_layers import SENSOR_DEPTH, sensor_depth


def add_sensor_depth(dataset: Dataset, settings: SensorSettings, *, progress: ProgressReporter = silent) -> Dataset:
    """Add the layer ``sensor_depth`` to a dataset of ours, in place of one made with other settings, and return it.

    ``settings`` has its seed. The layer is listed in ``dataset.json`` when all of its images are there; a run that was
    killed goes on with those that are missing. Raises InputError for a dataset of another format, without all of its
    depth images or that another process works on, and where the layer cannot be written.
    """
    folder = dataset.folder
    if dataset.metadata is None:
        raise InputError(
            f"{folder}: a {dataset.format_name} dataset has no place for layers; convert it first: "
            f"datagen convert {folder} OUT --format scanback"
        )
    dataset.require(dataset.frame_ids, parts=(DEPTH_PART,))
    with claiming(folder, range(len(dataset.frame_ids))):
        _write_layer(dataset, settings, progress)
    return open_dataset(folder)


def _write_layer(dataset: Dataset, settings: SensorSettings, progress: ProgressReporter) -> None:
    folder = dataset.folder
    metadata = read_metadata(folder)
    if metadata.sensor != settings:
        metadata = _begin_anew(dataset, metadata, settings)
    remove_unfinished(folder / SENSOR_DEPTH)
    missing = [i for i in dataset.frame_ids if not layer_file(folder, SENSOR_DEPTH, i).is_file()]
    advance = progress("Sensor", len(missing))
    for frame in missing:
        noisy = sensor_depth(
            dataset.depth(frame), dataset.camera, settings, frame=frame, depth_scale=dataset.depth_scale
        )
        write_layer(folder, SENSOR_DEPTH, frame, noisy, depth_scale=dataset.depth_scale)
        advance()
    if SENSOR_DEPTH not in metadata.layers:
        write_metadata(folder, metadata.model_copy(update={"layers": (*metadata.layers, SENSOR_DEPTH)}))


def _begin_anew(dataset: Dataset, metadata: Metadata, settings: SensorSettings) -> Metadata:
    """Remove images of other settings and record the new ones; whenever this is cut short, a rerun begins it again."""
    others = tuple(name for name in metadata.layers if name != SENSOR_DEPTH)
    without = metadata.model_copy(update={"layers": others, "sensor": None})
    write_metadata(dataset.folder, without)
    for image in (dataset.folder / SENSOR_DEPTH).glob(f"frame-*.{LAYERS[SENSOR_DEPTH].part}"):
        image.unlink()
    recipe = without.recipe
    if recipe.get("sensor") is not None:  # it would tell of images that are gone
        recipe = recipe | {"sensor": settings.model_dump(mode="json")}
    begun = without.model_copy(update={"sensor": settings, "recipe": recipe})
    write_metadata(dataset.folder, begun)
    return begun
