"""What a dataset could not show: faults whose presence would hardly change how well its frames fit."""

from dataclasses import replace

from datagen.dataset_check.diagnosis import Judged
from datagen.dataset_check.fitting import Judge

BLIND_SPOT_NAMES = {
    "half-pixel": "a principal point half a pixel off",
    "focal-length": "a focal length 3 % off",
    "depth-scale": "a depth scale 3 % off",
    "ray-distance": "ray distance in place of planar depth",
    "flipped-axis": "flipped camera axes",
    "inverse-pose": "inverted poses",
    "time-shift": "poses shifted by a frame",
}


def blind_spots(judge: Judge, found: Judged, sigma_factor: float, *, least_gain: float) -> list[str]:
    """Return the kinds of fault that would hardly show in these frames if they were there."""
    right = found.correction
    shifted = [replace(right, pose_shift=right.pose_shift + step) for step in (-1, 1)]
    faulty = {
        "half-pixel": [right.moved({"cx": 0.5, "cy": 0.5})],
        "focal-length": [right.moved({"log_f": 0.03})],
        "depth-scale": [right.moved({"log_depth": 0.03})],
        "ray-distance": [replace(right, ray_distance=not right.ray_distance)],
        "flipped-axis": [replace(right, axes=(right.axes[0], -right.axes[1], -right.axes[2]))],
        "inverse-pose": [replace(right, pose_form="inverse" if right.pose_form == "stored" else "stored")],
        "time-shift": shifted,
    }
    reference = judge.cost(right, sigma_factor=sigma_factor, every=2)
    return [
        kind
        for kind, corrections in faulty.items()
        if min(judge.cost(each, sigma_factor=sigma_factor, every=2) for each in corrections) < reference + least_gain
    ]
