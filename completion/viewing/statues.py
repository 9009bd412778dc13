"""A statue with sliders: its control mesh is posed, and the detail of the scan follows the moved normals."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.files import load_model
from model.statue.control.model import FOLDED, HOLE, MEASURED, Statue
from model.statue.detail.reconstruction import Reconstruction, coverage_at
from model.statue.detail.subdivision import chart_places, subdivide_uniform
from model.statue.files import BODY, body_model, load_statue
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.colors import part_colors
from scanprep.pictures.shading import CLAY, Solid
from scanprep.pictures.textures import bilinear

from .contents import Content, Stance, sizes
from .movable import MovableBody

LEVEL = 3                            # level of detail: 64 triangles for one of the control mesh; a move takes 1 to 4 ms


class MovableStatue(MovableBody):
    """The detailed surface of a statue in any pose of the model that moves its control mesh.

    Parameters
    ----------
    statue : Statue
        The statue.
    model : BodyModel
        Model of its control mesh.
    """

    def __init__(self, statue: Statue, model: BodyModel) -> None:
        super().__init__(model)
        fine = subdivide_uniform(statue.control.mesh, statue.control.chart, LEVEL)
        self.detailed = Reconstruction(statue.control, statue.map, fine)
        self._control = np.zeros((0, 3), dtype=np.float32)

    def vertices(self, betas: np.ndarray | None, pose: np.ndarray) -> np.ndarray:
        """Compute the detailed surface (n, 3) float32, metres, relative to the root's joint.

        [Statues] Eq. 19, 20
        """
        self._control = super().vertices(betas, pose)
        return self.detailed(self._control).astype(np.float32)

    def joint(self, part: str, y: np.ndarray) -> np.ndarray:
        """Compute the joint of a part in the control mesh of the latest vertices."""
        return super().joint(part, self._control)

    def mesh(self, betas: np.ndarray | None, pose: np.ndarray) -> Mesh:
        """Compute the detailed surface with the exact model."""
        return self.detailed.mesh(self.model.vertices(pose, betas))


def movable(model: BodyModel, statue: Statue | None) -> MovableBody:
    """Return what sliders move: the body of a model, or the surface of a statue."""
    return MovableBody(model) if statue is None else MovableStatue(statue, model)


def read_statue(name: str, folder: Path) -> Content:
    """Read the statue of a folder, with the model beside it, which knows the poses of people."""
    statue = load_statue(folder)
    model = load_model(folder / BODY) if (folder / BODY).is_file() else None
    same = model is not None and np.array_equal(model.template.faces, statue.control.mesh.faces)
    return of_statue(name, statue, model if same else None)


def of_statue(name: str, statue: Statue, model: BodyModel | None = None) -> Content:
    """Show the surface of a statue as the scan stood."""
    control = statue.control
    fine = subdivide_uniform(control.mesh, control.chart, LEVEL)
    mesh = Reconstruction(control, statue.map, fine).mesh()
    # colours for surface that was measured, folded over, or filled where the scan has a hole
    kind = coverage_at(control, statue.map, fine.parent, fine.bary)
    filled = (0.55, 0.66, 0.80)  # colour of surface that fills a hole of the scan
    measured = np.array([CLAY, (0.93, 0.62, 0.12), filled])[
        np.select([kind == MEASURED, kind == FOLDED, kind == HOLE], [0, 1, 2])]
    shades = {"parts": part_colors(control.skeleton.part_of_face)[fine.face_parent], "what was measured": measured}
    if statue.texture is not None:
        colors = bilinear(statue.texture, chart_places(control.chart, fine.parent, fine.bary)) / 255
        mesh, shades = Mesh(mesh.vertices, mesh.faces, colors), {"plain": np.array(CLAY), **shades}
    about = f"{sizes(mesh)}, {len(control.skeleton.parents)} parts"
    return Content(name, [Solid(mesh, shades=shades, name="statue")], Stance.of(mesh), about,
                   model=model or body_model(control), statue=statue)
