"""What operators that start jobs have in common."""

from collections.abc import Callable
from typing import Any

from ..errors import ReconstructionError
from ..jobs import runner
from ..jobs.job import Job, State, Work
from ..steps.reasons import why_no_job

WorkMaker = Callable[[Job], Work[str]]


class JobOperator:
    """An operator whose button begins a job and returns; a script's call waits until the job is done.

    ``prepare`` returns the work, and raises ReconstructionError where there is none to do.
    """

    bl_options = {"REGISTER"}  # noqa: RUF012 - the job makes its own undo step, when there is something to undo
    title = ""

    @classmethod
    def poll(cls, context: Any) -> bool:  # noqa: ARG003
        """Tell whether a job can begin, and why not."""
        reason = why_no_job()
        if reason is not None:
            cls.poll_message_set(reason)  # type: ignore[attr-defined]
        return reason is None

    def invoke(self, context: Any, event: Any) -> set[str]:  # noqa: ARG002
        """Begin the job: the interface goes on."""
        try:
            runner.start(self.title, self.prepare(context))
        except (ReconstructionError, OSError) as error:
            return self._refuse(_in_words(error))
        return {"FINISHED"}

    def execute(self, context: Any) -> set[str]:
        """Do the job and wait for it: for scripts."""
        try:
            job = runner.run_to_end(self.title, self.prepare(context))
        except (ReconstructionError, OSError) as error:
            return self._refuse(_in_words(error))
        runner.dismiss()
        if job.state is not State.DONE:
            return self._refuse(job.message)
        self.report({"INFO"}, job.message)  # type: ignore[attr-defined]
        return {"FINISHED"}

    def prepare(self, context: Any) -> WorkMaker:
        """Return the work that is to be done."""
        raise NotImplementedError

    def _refuse(self, message: str) -> set[str]:
        self.report({"ERROR"}, message)  # type: ignore[attr-defined]
        return {"CANCELLED"}


def _in_words(error: Exception) -> str:
    if isinstance(error, ReconstructionError):
        return str(error)
    assert isinstance(error, OSError)
    file = f"{error.filename}: " if error.filename else ""
    return f"{file}{error.strerror or error}; choose another folder, or change its permissions"
