"""The table: each bar of each trial of each subject, what was reached, and whether that is enough."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from fusion.pose_benchmark.case_files import CaseResult
from fusion.pose_benchmark.protocol import Trial
from fusion.pose_benchmark.subjects import Subject


@dataclass(frozen=True, kw_only=True)
class Row:
    """One number: ``reached`` in ``unit``, None where the cases do not tell it; ``passed`` None where no bar is set."""

    subject: str
    trial: str
    title: str
    cases: int
    what: str
    unit: str
    bar: str
    at_least: float | None
    at_most: float | None
    reached: float | None
    passed: bool | None

    @property
    def reached_in_words(self) -> str:
        """The number as people read it."""
        if self.reached is None:
            return "–"
        digits = 1 if self.unit in ("%", "ms") else 3
        return f"{self.reached:.{digits}f} {self.unit}"

    @property
    def verdict(self) -> str:
        """Whether it is enough, in a word."""
        return {True: "pass", False: "FAIL", None: ""}[self.passed]


def summarize(subject: Subject, trial: Trial, cases: Sequence[CaseResult]) -> list[Row]:
    """Return a trial's rows for a subject."""
    rows = []
    for bar in trial.bars:
        reached = bar.measure(cases)
        has_bar = bar.at_least is not None or bar.at_most is not None
        rows.append(
            Row(
                subject=subject.name,
                trial=trial.name,
                title=trial.title,
                cases=len(cases),
                what=bar.what,
                unit=bar.unit,
                bar=bar.wording,
                at_least=bar.at_least,
                at_most=bar.at_most,
                reached=reached,
                # What cannot be told, for too many failed, is not reached.
                passed=(False if has_bar else None) if reached is None else bar.passes(reached),
            )
        )
    return rows


def rows_as_json(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return rows for scripts."""
    return [asdict(row) for row in rows]


def as_markdown(rows: Sequence[Row]) -> str:
    """Return the table in Markdown, a heading for each subject."""
    lines: list[str] = []
    subject = None
    for row in rows:
        if row.subject != subject:
            subject = row.subject
            lines += [
                "",
                f"## {subject}",
                "",
                "| trial | cases | what | bar | reached | |",
                "| --- | --- | --- | --- | --- | --- |",
            ]
        cells = (row.title, str(row.cases), row.what, row.bar, row.reached_in_words, row.verdict)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines).lstrip("\n") + "\n"
