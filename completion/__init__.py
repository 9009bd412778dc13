"""The whole body from a partial scan, from markers, or from frames of points."""
import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
