"""What `scape prep run` was called with, kept in the set, so that the same can be done again from elsewhere."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from ..batch.calls import KeptCall
from ..geometry.files import read_mesh
from ..geometry.landmarks import landmarks_beside, read_template_landmarks
from ..geometry.mesh import Mesh
from .prepare import PrepareConfig
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
        body, tasks, through = read_mesh(self.template), self.tasks(), self.config.scan.through
        without = [task.name for task in tasks if task.landmarks is None]
        # the set keeps those of the template in any case: what is learned from it is measured by them
        named = self.template_landmarks or landmarks_beside(self.template)
        marks = read_template_landmarks(self.template, body, self.template_landmarks) if named else {}
        if through == "pose":
            tell("note: no landmarks are used; all scans must be near the template's pose")
        elif len(without) == len(tasks):
            tell("note: no landmarks are used; look at the page for scans turned round or mirrored")
        else:                                          # some scan is led by landmarks
            marks = marks or read_template_landmarks(self.template, body, self.template_landmarks)
            if without:
                tell(f"note: no landmarks for {len(without)} of {len(tasks)} scans ({', '.join(without[:LISTED])}); "
                     "look at the page for those turned round or mirrored")
        return tasks, body, marks
