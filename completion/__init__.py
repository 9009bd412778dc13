"""The whole body from a partial scan, from markers, or from frames of points."""
import scanprep  # noqa: F401, I001  first, as it handles Ctrl-C while the rest loads
import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
