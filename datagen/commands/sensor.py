"""``datagen sensor``: the depth that a real sensor would give, added to a dataset."""

import argparse
from pathlib import Path

from pydantic import ValidationError

from datagen.commands.job_options import add_job_options, reporting
from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from datagen.pydantic_errors import describe_validation_error
from datagen.scene_spec.sensor_settings import SensorSettings
from datagen.sensors.add_layers import add_sensor_depth
from datagen.sensors.depth_sensors import SENSORS

SETTINGS = ("model", "seed", "axial", "lateral", "quantisation", "grazing", "shadow", "edges", "nearest", "farthest")


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument("dataset", metavar="DATASET", type=Path, help="a Scanback dataset")
    command.add_argument("--model", choices=tuple(SENSORS), required=True, help="the sensor that is simulated")
    command.add_argument("--seed", type=int, metavar="N", help="of the noise (default: that of the rendering)")
    for name, what in (
        ("axial", "the noise along z"),
        ("lateral", "how far edges move"),
        ("quantisation", "the steps"),
    ):
        command.add_argument(
            f"--{name}", type=float, default=1.0, metavar="X", help=f"multiplies {what}; 0 turns it off"
        )
    for name, where in (
        ("grazing", "at grazing angles"),
        ("shadow", "where the second view does not see"),
        ("edges", "at edges"),
    ):
        command.add_argument(f"--no-{name}", dest=name, action="store_false", help=f"keep returns {where}")
    command.add_argument("--nearest", type=float, metavar="M", help="metres; nearer is lost (default: the model's)")
    command.add_argument("--farthest", type=float, metavar="M", help="metres; farther is lost (default: the model's)")
    add_job_options(command)
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    dataset = open_dataset(options.dataset)
    chosen = {name: getattr(options, name) for name in SETTINGS}
    if chosen["seed"] is None:
        render = dataset.metadata.recipe.get("render") if dataset.metadata is not None else None
        chosen["seed"] = render.get("seed", 0) if isinstance(render, dict) else 0
    try:
        settings = SensorSettings.model_validate(chosen)
    except ValidationError as error:
        raise InputError(describe_validation_error("sensor settings", error, SensorSettings)) from error
    with reporting(options) as progress:
        add_sensor_depth(dataset, settings, progress=progress)
    print(
        f"{options.dataset}: the layer sensor_depth has {len(dataset.frame_ids)} frames as a {settings.model} would "
        f"see them, seed {settings.seed}"
    )
