"""What a check found, as values."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

Severity = Literal["fault", "note"]

AMBIGUOUS = "ambiguous"
CANNOT_TELL = "cannot-tell"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing found: ``kind`` for programs, ``message`` and ``remedy`` for people, ``evidence`` in numbers.

    A ``fault`` makes what is built on the dataset wrong; a ``note`` is worth knowing. ``evidence`` is ready for JSON.
    """

    kind: str
    severity: Severity
    message: str
    remedy: str
    evidence: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class CheckReport:
    """All findings, faults first, and what they rest on: numbers of frames, pairs and residuals, ready for JSON."""

    dataset: str
    findings: tuple[Finding, ...]
    basis: dict[str, Any]

    @property
    def has_faults(self) -> bool:
        """Whether any finding is a fault."""
        return any(finding.severity == "fault" for finding in self.findings)

    def as_json(self) -> dict[str, Any]:
        """Return the report ready for JSON."""
        return asdict(self) | {"verdict": "faults" if self.has_faults else "clean"}
