"""The call of `scape prep run`, kept in the set, so that the same scans can be registered again."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from ..batch.calls import KeptCall
from ..geometry.files import read_mesh
from ..geometry.landmarks import find_template_landmarks, read_template_landmarks
from ..geometry.mesh import Mesh
from .prepare import PrepareConfig
from .scans import ScanTask, find_scans

LISTED = 5                    # scans that one line names: more would not be read


@dataclass(frozen=True)
class Call(KeptCall):
    """Scans, template and settings of a set; paths are absolute after reading."""

    command: ClassVar[str] = "scape prep run"
    scans: Path
    template: Path
    landmarks: Path | None = None
    template_landmarks: Path | None = None
    subject: str = ""
    config: PrepareConfig = field(default_factory=PrepareConfig)

    def tasks(self) -> list[ScanTask]:
        """Find the scans that are in the folder now."""
        return find_scans(self.scans, self.landmarks, self.subject)

    def inputs(self, say: Callable[[str], None]) -> tuple[list[ScanTask], Mesh, dict[str, int]]:
        """Read scans, template and its landmarks from their files; `say` gets a note about scans without landmarks."""
        template, tasks, through = read_mesh(self.template), self.tasks(), self.config.scan.through
        without = [task.name for task in tasks if task.landmarks is None]
        # the set keeps the template's landmarks even if no scan has any: models learned from it measure bodies by them
        landmarks = find_template_landmarks(self.template, template, self.template_landmarks)
        if through == "pose":
            say("no landmarks are used; all scans must be near the template's pose")
        elif len(without) == len(tasks):
            say("no landmarks are used; look at the page for scans turned round or mirrored")
        else:                                          # at least one scan has landmarks, so the template needs them
            landmarks = landmarks or read_template_landmarks(self.template, template, self.template_landmarks)
            if without:
                say(f"no landmarks for {len(without)} of {len(tasks)} scans ({', '.join(without[:LISTED])}); "
                    "look at the page for those turned round or mirrored")
        return tasks, template, landmarks
