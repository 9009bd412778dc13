"""What a folder holds."""
from scanprep.batch.ownership import HOME


def tree(folder, *apart):
    """Path -> bytes of all files but those of these names, and what scapekit keeps there for itself."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*"))
            if p.is_file() and p.name not in apart and HOME not in p.parts}
