"""All checks of a dataset, one after the other."""

import numpy as np

from datagen.dataset import Dataset
from datagen.dataset_check.color_check import check_color
from datagen.dataset_check.findings import CheckReport, Finding
from datagen.dataset_check.frame_facts import read_frames
from datagen.dataset_check.geometry_check import LEAST_GEOMETRY_DEPTH, check_geometry
from datagen.dataset_check.hygiene import check_files, check_images, check_intrinsics
from datagen.dataset_check.trajectory_check import check_trajectory
from datagen.errors import InputError
from datagen.progress import ProgressReporter, silent


def check_dataset(
    dataset: Dataset, frame_ids: tuple[int, ...] | None = None, *, seed: int = 0, progress: ProgressReporter = silent
) -> CheckReport:
    """Check the chosen frames of a dataset (default: all), and name what is wrong.

    ``seed`` decides which pixels are compared. Raises InputError where not one frame can be used for anything.
    """
    chosen = dataset.frame_ids if frame_ids is None else frame_ids
    facts = read_frames(dataset, chosen, progress("Reading", len(chosen)))
    done = progress("Comparing", 2)
    rng = np.random.default_rng([seed, 0])
    findings = [*check_files(facts), *check_intrinsics(dataset.camera), *check_images(facts), *check_trajectory(facts)]
    basis: dict[str, object] = {"frames_read": len(facts)}
    usable = [each for each in facts if each.pose is not None and each.valid_share >= LEAST_GEOMETRY_DEPTH]
    if usable:
        found, numbers = check_geometry(dataset, facts, rng)
        findings += found
        basis |= numbers
    elif not any(finding.kind == "flipped-axis" for finding in findings):
        raise InputError(_nothing_usable(dataset, findings, len(facts)))
    done()
    if any(each.color_digest is not None for each in facts):
        geometry_holds = bool(usable) and not any(finding.severity == "fault" for finding in findings)
        findings += check_color(dataset, facts, rng, geometry_holds=geometry_holds)
    done()
    findings.sort(key=lambda finding: finding.severity != "fault")
    return CheckReport(dataset=str(dataset.folder), findings=tuple(findings), basis=basis)


def _nothing_usable(dataset: Dataset, findings: list[Finding], count: int) -> str:
    reason = findings[0].message if findings else "none has both a pose and depth."
    return f"{dataset.folder}: none of the {count} frames can be checked: {reason.rstrip('.')}; mend these first"
