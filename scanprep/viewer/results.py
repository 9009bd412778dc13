"""Results of a command in the browser: worst first, to correct and compute again in the same folder."""
from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ..batch.opening import workspace
from ..batch.room import Progress
from ..batch.workspace import Workspace
from ..console import Outcome, keep_report
from ..judgement import Judgement
from .app import Send
from .messages import Message
from .pick import PickApp


class ResultsApp(PickApp):
    """A page for correcting results: bodies to click on, and a judgement on each.

    Subclasses say what is clicked (`PickApp`), how good the results are, and how they are shown.
    """

    folder: Path                # of the results
    no_result = "not done yet"  # shown for a body without result
    outside = ""                # question about files outside of the folder, until the page has shown it

    def judgements(self) -> Iterable[Judgement | None]:
        """Yield the judgement on every body in order; None for one without result."""
        raise NotImplementedError

    def read_results(self) -> Any:
        """Read the results that the folder holds now."""
        raise NotImplementedError

    def show_results(self, results: Any) -> None:
        """Show results that were read."""
        raise NotImplementedError

    def handle(self, message: Message, send: Send) -> None:
        """Act on a message; the first that could change a file outside of the folder is refused with a question."""
        if self.outside and message.kind not in ("open", "choose", "frame"):
            question, self.outside = self.outside, ""
            raise ValueError(question)
        super().handle(message, send)

    def more(self) -> dict[str, Any]:
        """Add the judgements to the state."""
        return {**super().more(), "verdicts": [
            {"verdict": "new", "reasons": [self.no_result]} if one is None else
            {"verdict": one.verdict, "reasons": list(one.reasons)} for one in self.judgements()]}

    def do_again(self, what: str, command: str, do: Callable[[Workspace, Progress], tuple[Outcome, str]], send: Send,
                 failed: str, give_up: Callable[[], None] = lambda: None) -> None:
        """Run a command again while clicks go on, and show its results.

        The output is locked only meanwhile. `do` returns the outcome and what to say at the end. `give_up` is called
        when it raises an error, which is reported after `failed`.
        """
        def work(report_progress: Progress) -> str:
            begin = time.perf_counter()
            try:
                with workspace(self.folder) as space:
                    outcome, note = do(space, report_progress)
                    keep_report(space, outcome, command, time.perf_counter() - begin)
            except Exception:
                with self._lock:
                    give_up()
                raise
            results = self.read_results()
            with self._lock:
                self.show_results(results)
                scene = self.scene()
            send(scene)
            return note

        self.beside(what, work, send, failed)
