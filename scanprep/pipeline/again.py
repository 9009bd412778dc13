"""What `scape prep run` was called with, kept in the set, so that the same can be done again from elsewhere."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from ..batch.calls import KeptCall
from ..geometry.files import read_mesh
from ..geometry.landmarks import landmarks_beside, read_template_landmarks
from ..geometry.mesh import Mesh
from .prepare import PrepareConfig
from .scan import Init
from .scans import ScanTask, find_scans

LISTED = 5                    # scans that a line names


@dataclass(frozen=True)
class Call(KeptCall):
    """Scans, template and settings of a set; paths are absolute once they were read."""

    command: ClassVar[str] = "scape prep run"
    scans: Path
    template: Path
    landmarks: Path | None = None
    template_landmarks: Path | None = None
    subject: str = ""
    config: PrepareConfig = field(default_factory=PrepareConfig)

    def tasks(self) -> list[ScanTask]:
        """The scans as they are now."""
        return find_scans(self.scans, self.landmarks, self.subject)

    def inputs(self, tell: Callable[[str], None]) -> tuple[list[ScanTask], Mesh, dict[str, int]]:
        """Scans, template and its landmarks, as their files are now; told of scans without landmarks."""
        body, tasks = read_mesh(self.template), self.tasks()
        marks, note = _template_marks(self.template, self.template_landmarks, body, tasks, self.config.scan.init)
        if note:
            tell(f"note: {note}")
        return tasks, body, marks


def _template_marks(template: Path, given: Path | None, body: Mesh, tasks: Sequence[ScanTask], init: Init
                    ) -> tuple[dict[str, int], str]:
    """The landmarks of the template, where any scan is led by landmarks; and what is to be told."""
    without = [task.name for task in tasks if task.landmarks is None]
    # the set keeps those of the template in any case: what is learned from it is measured by them
    kept = read_template_landmarks(template, body, given) if given or landmarks_beside(template) else {}
    if init == "pose":
        return kept, "no landmarks are used; all scans must be near the template's pose"
    if init == "automatic" or (init == "best" and len(without) == len(tasks)):
        return kept, "no landmarks are used; look at the page for scans turned round or mirrored"
    note = (f"no landmarks for {len(without)} of {len(tasks)} scans ({', '.join(without[:LISTED])}); "
            "look at the page for those turned round or mirrored") if without and init == "best" else ""
    return kept or read_template_landmarks(template, body, given), note
