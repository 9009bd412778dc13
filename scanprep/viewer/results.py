"""What a command made of many things, in the browser: worst first, mended, and done again in the same folder."""
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
from .pick import PickApp


class ResultsApp(PickApp):
    """The state of a page on which results are mended: bodies to click on, and what is to be thought of each.

    What is built on it says what is clicked (`PickApp`), what the results are worth, and how they are shown.
    """

    folder: Path                 # of the results
    no_result = "not done yet"  # said of a body without a result

    def judgements(self) -> Iterable[Judgement | None]:
        """Of the bodies in their order; None for one that has no result."""
        raise NotImplementedError

    def read_results(self) -> Any:
        """What the folder holds now."""
        raise NotImplementedError

    def show_results(self, results: Any) -> None:
        """Show what was read."""
        raise NotImplementedError

    def more(self) -> dict[str, Any]:
        """What is to be thought of each body besides."""
        return {**super().more(), "verdicts": [
            {"verdict": "new", "reasons": [self.no_result]} if one is None else
            {"verdict": one.verdict, "reasons": list(one.reasons)} for one in self.judgements()]}

    def do_again(self, what: str, command: str, do: Callable[[Workspace, Progress], tuple[Outcome, str]], send: Send,
                 failed: str, give_up: Callable[[], None] = lambda: None) -> None:
        """Do the work of a command again beside the clicks that go on, and show what came of it.

        The output is open, and closed to other runs, only meanwhile. `do` returns what to say at the end besides;
        `give_up` is called where it raises an error, which is told after `failed`.
        """
        def work(tell: Progress) -> str:
            begin = time.perf_counter()
            try:
                with workspace(self.folder) as space:
                    outcome, note = do(space, tell)
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
