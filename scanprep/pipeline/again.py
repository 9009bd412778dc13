"""The call of `scape prep run`, kept in the set, so that the same scans can be registered again."""
from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import ClassVar

from ..batch.calls import KeptCall
from ..batch.opening import workspace
from ..batch.workspace import Workspace
from ..geometry.files import read_mesh
from ..geometry.landmarks import find_template_landmarks, read_template_landmarks
from ..geometry.mesh import Mesh
from .prepare import PrepareConfig, Prepared, Progress, prepare
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


def register_scans(scans: str | Path, template: str | Path, output: str | Path, landmarks: str | Path | None = None,
                   config: PrepareConfig | None = None, progress: Progress | None = None) -> Prepared:
    """Register a template to every scan of a folder and find the skeleton, as `scape prep run` does.

    Called again, it does only what changed or is missing. `report.html` in the output shows the scans, worst first.

    Parameters
    ----------
    scans : str or Path
        Folder of meshes or point clouds, with their landmarks, and `scans.csv` if there is one.
    template : str or Path
        Mesh to bring onto the scans, with its landmarks beside it, if it has some.
    output : str or Path
        Folder of the registered set.
    landmarks : str or Path, optional
        Folder of landmark files with the names of the scans, if it is another.
    config : PrepareConfig, optional
        Settings.
    progress : callable, optional
        Called as progress(done, total), counting scans.

    Returns
    -------
    Prepared
        The set as `registered`, `figures` of every scan, `failures`, and a `judgement`.

    Raises
    ------
    ValueError
        No scans, an unsuitable template, or a folder with other scans registered with another template.

    Examples
    --------
    >>> import igl
    >>> from scanprep import Mesh, RegistrationConfig, write_mesh
    >>> from scanprep.pipeline.prepare import PrepareConfig, ScanSettings
    >>> vertices, faces = igl.icosahedron()
    >>> vertices, faces = igl.upsample(vertices, faces.astype(np.int64), 2)
    >>> ball = Mesh(vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces)
    >>> write_mesh("template.ply", ball)
    >>> write_mesh("scans/anna.ply", ball.with_vertices(1.1 * ball.vertices))
    >>> quick = PrepareConfig(ScanSettings(RegistrationConfig.quick(), through="pose"))
    >>> register_scans("scans", "template.ply", "set", config=quick).registered.names
    ('anna',)
    """
    call = Call(Path(scans), Path(template), None if landmarks is None else Path(landmarks),
                config=config or PrepareConfig())
    inputs = call.inputs(partial(warnings.warn, stacklevel=2))
    with workspace(output) as space:
        return prepare_set(call, inputs, space, *([] if progress is None else [progress]))


def prepare_set(call: Call, inputs: tuple[list[ScanTask], Mesh, dict[str, int]], space: Workspace, *progress: Progress
                ) -> Prepared:
    """Register the scans that have changed into an open set, and keep the call there; `progress` as of `prepare`."""
    prepared = prepare(*inputs, space.folder, call.config, *progress)
    with space.staging("run") as staged:
        call.write(staged.folder)
    return prepared
