"""The registered set: a folder of meshes in one topology, which `scanprep` writes and `model` learns from."""
from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import astuple, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from .geometry import storage, tables
from .geometry.files import MeshFileError, check_same_topology, read_mesh, write_mesh
from .geometry.mesh import Mesh
from .skeleton.tree import Skeleton
from .words import check_names

# version and kind in the header, `set.json`: files of another version are refused
VERSION = 1
KIND = "registered set"


@dataclass(frozen=True)
class SetEntry:
    """One registered mesh: a row of `set.csv`; empty where something is not known."""

    name: str               # unique in the set, and the name of its file
    subject: str = ""
    pose: str = ""
    sex: str = ""
    file: str = ""          # path inside the folder of the set


# columns of `set.csv`
_COLUMNS = [f.name for f in fields(SetEntry)]


@dataclass(frozen=True, eq=False)
class RegisteredSet:
    """A folder of registered meshes: `template.ply`, `meshes/*.ply`, `set.csv`, `skeleton.json`, `set.json`.

    Every change is on disk when the method returns, completely or not at all, so that interrupted work can be resumed.
    The object itself never changes: methods return the new set.

    Parameters
    ----------
    folder : Path
        Folder of the set.
    template : Mesh
        The mesh that was registered to the scans.
    entries : tuple of SetEntry
        The registered meshes, in the order in which they were added.
    skeleton : Skeleton, optional
        Parts and joints of the template.
    info : dict
        What else `set.json` says.

    Examples
    --------
    >>> import tempfile
    >>> from scanprep import RegisteredSet
    >>> from scanprep.synthetic.people import SyntheticPerson
    >>> person = SyntheticPerson()
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     registered = RegisteredSet.create(folder, person.mesh).add("anna", person.mesh, subject="anna")
    ...     registered.names, registered.shapes().shape == (1, *person.mesh.vertices.shape)
    (('anna',), True)
    """

    folder: Path
    template: Mesh
    entries: tuple[SetEntry, ...] = ()
    skeleton: Skeleton | None = None
    info: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"RegisteredSet({self.folder}, {len(self.entries)} meshes of {len(self.subjects)} subjects)"

    @staticmethod
    def create(folder: str | Path, template: Mesh, info: dict[str, Any] | None = None) -> RegisteredSet:
        """Create a set, or open the one in the folder.

        Parameters
        ----------
        folder : str or Path
            Folder of the set.
        template : Mesh
            The mesh that is registered to the scans.
        info : dict, optional
            Values for JSON, kept in `set.json`.

        Returns
        -------
        RegisteredSet

        Raises
        ------
        ValueError
            The folder holds a set with another template.
        """
        folder = Path(folder)
        if (folder / "set.json").exists():
            old = RegisteredSet.load(folder)
            # a micrometre apart is still the same template: files hold single precision
            if not (np.array_equal(old.template.faces, template.faces)
                    and np.allclose(old.template.vertices, template.vertices, rtol=0, atol=1e-6)):
                raise ValueError(f"folder: {folder} holds a set of another template, {old.template}; "
                                 f"expected {template}")
            return old
        write_set(folder, template, (), info)
        return RegisteredSet.load(folder)

    @staticmethod
    def load(folder: str | Path) -> RegisteredSet:
        """Read a set; its meshes stay on disk until they are needed.

        Parameters
        ----------
        folder : str or Path
            Folder of the set.

        Returns
        -------
        RegisteredSet

        Raises
        ------
        MeshFileError, StorageError
            A file is missing, damaged or of an unknown version; the message names it.
        """
        folder = Path(folder)
        info = _read_header(folder)
        template, up = read_mesh(folder / "template.ply", unit="m"), info.pop("up", None)
        if up not in (None, "x", "y", "z"):
            raise storage.StorageError(f"{folder / 'set.json'}: up: expected x, y or z, found {str(up)[:20]!r}")
        template = template if up is None else replace(template, up="xyz".index(up))
        if [len(template.vertices), len(template.faces)] != [info.pop("vertices"), info.pop("faces")]:
            raise MeshFileError(f"{folder / 'template.ply'}: found {template}, set.json says otherwise")
        path = folder / "skeleton.json"
        skeleton = Skeleton.load(path) if path.exists() else None
        if skeleton is not None and len(skeleton.part_of_face) != len(template.faces):
            raise storage.StorageError(f"{path}: expected {len(template.faces)} faces as template.ply has, "
                                       f"found {len(skeleton.part_of_face)}")
        return RegisteredSet(folder, template, read_entries(folder), skeleton, info)

    def add(self, name: str, mesh: Mesh | np.ndarray, subject: str = "", pose: str = "", sex: str = ""
            ) -> RegisteredSet:
        """Write a mesh into the set; one of the same name is replaced.

        Parameters
        ----------
        name : str
            A valid file name: no dot in front and none of `<>:"/\\|?*`.
        mesh : Mesh or (N, 3) float, metres
            Mesh in the topology of the template, or its vertices.
        subject : str
            Whose scan it is.
        pose : str
            Name of the pose.
        sex : str
            "female", "male" or unknown.

        Returns
        -------
        RegisteredSet
            The set with the mesh.

        Raises
        ------
        ValueError
            The name cannot be a file name, or the mesh has another topology.
        """
        if not re.fullmatch(r"[^.<>:\"/\\|?*\x00-\x1f][^<>:\"/\\|?*\x00-\x1f]*", name):
            raise ValueError(f"name: expected one that can be a file, without a dot in front, got {name!r}")
        if not isinstance(mesh, Mesh):
            if np.shape(mesh) != self.template.vertices.shape:
                raise ValueError(f"mesh: expected vertices {self.template.vertices.shape}, got {np.shape(mesh)}")
            mesh = self.template.with_vertices(mesh)
        check_same_topology(Path(name), mesh, self.folder / "template.ply", self.template)
        entry = SetEntry(name, subject, pose, sex, f"meshes/{name}.ply")
        rows = {row.name: row for row in read_entries(self.folder)}
        check_names([*rows, name], str(self.folder))
        write_mesh(storage.place_to_write(self.folder, entry.file, self.folder), replace(mesh, attached=None))
        rows[name] = entry                               # replaces an entry of the same name in its place
        _write_rows(self.folder, rows.values())
        return replace(self, entries=tuple(rows.values()))

    def with_skeleton(self, skeleton: Skeleton) -> RegisteredSet:
        """Write a skeleton into the set.

        Parameters
        ----------
        skeleton : Skeleton
            Parts and joints of the template.

        Returns
        -------
        RegisteredSet
            The set with the skeleton.

        Raises
        ------
        ValueError
            The skeleton is of another triangulation.
        """
        if len(skeleton.part_of_face) != len(self.template.faces):
            raise ValueError(f"skeleton: expected {len(self.template.faces)} faces as the template has, "
                             f"got {len(skeleton.part_of_face)}")
        skeleton.save(self.folder / "skeleton.json")
        return replace(self, skeleton=skeleton)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all meshes."""
        return tuple(entry.name for entry in self.entries)

    @property
    def subjects(self) -> tuple[str, ...]:
        """Every subject once, in order of appearance."""
        return tuple(dict.fromkeys(entry.subject for entry in self.entries))

    def vertices(self, names: Sequence[str] | None = None) -> np.ndarray:
        """Read the vertices of meshes.

        Parameters
        ----------
        names : sequence of str, optional
            Which meshes; by default all.

        Returns
        -------
        (M, N, 3) float, metres

        Raises
        ------
        MeshFileError
            A mesh is missing, damaged or of another topology.
        ValueError
            An unknown name.
        """
        by_name = {entry.name: entry for entry in self.entries}
        unknown = [name for name in names or () if name not in by_name]
        if unknown:
            raise ValueError(f"names: {', '.join(unknown)} not in {self.folder}, which has {', '.join(by_name)}")
        wanted = self.entries if names is None else [by_name[name] for name in names]
        out = np.empty((len(wanted), *self.template.vertices.shape))
        for place, entry in zip(out, wanted, strict=True):
            mesh = read_mesh(self.folder / entry.file, unit="m")
            check_same_topology(self.folder / entry.file, mesh, self.folder / "template.ply", self.template)
            place[:] = mesh.vertices
        return out

    def poses(self, subject: str | None = None) -> np.ndarray:
        """Read the vertices of all meshes of one subject.

        Parameters
        ----------
        subject : str, optional
            By default the subject with the most meshes.

        Returns
        -------
        (M, N, 3) float, metres

        Raises
        ------
        ValueError
            An unknown subject, or an empty set.
        """
        return self.vertices(self.names_of(subject))

    def names_of(self, subject: str | None = None) -> tuple[str, ...]:
        """Return the names of all meshes of one subject, by default of the one with the most, as `poses` reads them."""
        if not self.entries:
            raise ValueError(f"{self.folder}: the set holds no meshes")
        count = [entry.subject for entry in self.entries].count
        wanted = max(self.subjects, key=count) if subject is None else subject
        if wanted not in self.subjects:
            raise ValueError(f"subject: expected one of {', '.join(self.subjects)}, got {wanted!r}")
        return tuple(entry.name for entry in self.entries if entry.subject == wanted)

    def shapes(self) -> np.ndarray:
        """Read the vertices of one mesh of every subject, the one that was added first.

        Returns
        -------
        (S, N, 3) float, metres
        """
        first = {entry.subject: entry.name for entry in reversed(self.entries)}
        return self.vertices([first[subject] for subject in self.subjects])


def write_set(folder: Path, template: Mesh, entries: Sequence[SetEntry], info: dict[str, Any] | None = None) -> None:
    """Write everything of a set but its meshes and skeleton."""
    write_mesh(folder / "template.ply", replace(template, attached=None))
    _write_rows(folder, entries)
    header = {"kind": KIND, "version": VERSION, "vertices": len(template.vertices), "faces": len(template.faces),
              **({} if template.up is None else {"up": "xyz"[template.up]}), **(info or {})}
    storage.write_json(folder / "set.json", header)              # last: a folder with this file is a complete set


def _read_header(folder: Path) -> dict[str, Any]:
    """Read `set.json`; StorageError for another kind of file or an unknown version."""
    path = folder / "set.json"
    info = storage.read_json(path, "the header of a registered set")
    if not isinstance(info, dict) or info.pop("kind", None) != KIND or not {"vertices", "faces"} <= set(info):
        raise storage.StorageError(f"{path}: expected the header of a registered set, found something else")
    version = info.pop("version", None)
    if version != VERSION:
        raise storage.StorageError(f"{path}: version {version} of registered sets is not known here "
                                   f"(known: {VERSION})")
    return info


def read_entries(folder: Path, being_made: Collection[str] = ()) -> tuple[SetEntry, ...]:
    """Read the rows of `set.csv`; mesh files of the names in `being_made` may be missing.

    StorageError, which names the line, for a missing file, one outside the folder, or a name that occurs twice.
    """
    path = folder / "set.csv"
    entries: dict[str, SetEntry] = {}
    for line, row in tables.read_table(path, _COLUMNS, ("name", "file")):
        entry = SetEntry(**{column: row[column] for column in _COLUMNS})
        storage.path_inside(folder, entry.name, f"{path}: line {line}")       # the name also names files elsewhere
        place = storage.path_inside(folder, entry.file, f"{path}: line {line}")
        if not place.is_file() and entry.name not in being_made:
            raise storage.StorageError(f"{path}: line {line}: there is no file {entry.file}")
        if entry.name in entries:
            raise storage.StorageError(f"{path}: line {line}: the name {entry.name} comes twice")
        entries[entry.name] = entry
    return tuple(entries.values())


def _write_rows(folder: Path, rows: Iterable[SetEntry]) -> None:
    """Write `set.csv`."""
    tables.write_table(folder / "set.csv", _COLUMNS, map(astuple, rows))
