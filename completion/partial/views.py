"""The scans named on the command line: meshes or clouds with all they have, normals, colours, textures."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from scanprep.geometry.files import POINT_ENDINGS, PointCloud, read_mesh, read_points
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.textures import Texture, read_texture


@dataclass(frozen=True, eq=False)
class ScanFiles:
    """The views of one scan."""

    views: tuple[Mesh | PointCloud, ...]  # Mesh or PointCloud of each file
    textures: tuple[Texture | None, ...]  # Texture or None of each

    @property
    def colored(self) -> bool:
        """Whether any view has colours or a texture."""
        return any(t is not None or v.colors is not None for v, t in zip(self.views, self.textures, strict=True))

    @property
    def mesh(self) -> Mesh | None:
        """What vertices and faces of a landmark file can refer to: the mesh, where there is one view."""
        only = self.views[0]
        return only if len(self.views) == 1 and isinstance(only, Mesh) else None


def read_views(paths: Sequence[Path], unit: str | None = None) -> ScanFiles:
    """Read the views of a scan."""
    views = tuple(read_view(path, unit) for path in paths)
    return ScanFiles(views, tuple(read_texture(path, unit) if isinstance(view, Mesh) else None
                                  for path, view in zip(paths, views, strict=True)))


def read_view(path: Path, unit: str | None = None) -> Mesh | PointCloud:
    """A mesh, or the points of a file without triangles with the normals and colours that it has."""
    if path.suffix.lower() in POINT_ENDINGS:
        return read_points(path, unit)
    try:
        return read_mesh(path, unit)
    except ValueError as error:
        if "no faces" in str(error):
            return read_points(path, unit)
        raise
