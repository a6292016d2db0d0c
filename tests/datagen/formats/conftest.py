import shutil

import pytest
from converted_datasets import convert, write_source

from datagen.open_dataset import open_dataset


@pytest.fixture(scope="session")
def kept(tmp_path_factory):
    """Folders that are made once: {name: folder}."""
    folder = tmp_path_factory.mktemp("formats")
    return {"source": write_source(folder / "source").folder}


@pytest.fixture
def source(kept, tmp_path):
    """A dataset of ours: five frames around a sphere before a wall, the cameras rolled, with a true mesh."""
    return open_dataset(shutil.copytree(kept["source"], tmp_path / "source"))


@pytest.fixture
def converted(kept, tmp_path):
    """Give a copy of the source dataset in the format of a name."""

    def copy(name):
        if name not in kept:
            kept[name] = convert(open_dataset(kept["source"]), kept["source"].parent / name, name)
        return shutil.copytree(kept[name], tmp_path / name)

    return copy
