"""All dataset formats, in the order in which a folder is tried on them."""

from datagen.formats import scanback, seven_scenes
from datagen.formats.format import DatasetFormat

FORMATS: tuple[DatasetFormat, ...] = (scanback.FORMAT, seven_scenes.FORMAT)
