"""From raw range scans to registered meshes and a skeleton."""
from .interrupts import leave_if_command

leave_if_command()

import lazy_loader  # noqa: E402

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
