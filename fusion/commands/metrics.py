"""How a mesh's distance from the truth is printed."""

from typing import Any

from rich.console import Console
from rich.table import Table


def print_metrics(metrics: dict[str, Any]) -> None:
    """Print what ``evaluate`` returned."""
    table = Table.grid(padding=(0, 2))
    for name in ("accuracy", "completeness", "chamfer"):
        voxels = f" ({metrics[f'{name}_voxels']:.3f} voxels)" if f"{name}_voxels" in metrics else ""
        table.add_row(name, f"{1000 * metrics[f'{name}_m']:.4f} mm{voxels}")
    for entry in metrics["fscores"]:
        table.add_row(f"F-score at {1000 * entry['threshold_m']:.3g} mm", f"{100 * entry['fscore']:.2f} %")
    table.add_row("normal consistency", f"{metrics['normal_consistency']:.4f}")
    Console().print(table)
