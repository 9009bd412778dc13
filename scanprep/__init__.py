"""From raw range scans to registered meshes and a skeleton."""
import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
